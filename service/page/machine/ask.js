/**
 * A question in its place on the screen, because a dialog would lie over HOLD and STOP.
 *
 * guardedButton("Unlock", {words, yes, act}) is a button that becomes the question; the harmless answer has the focus.
 */

import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";

export function guardedButton(label, { words, yes, act, kind = "" }) {
  const place = h("div", { class: "ask" });
  const button = h("button", { type: "button", class: kind, onclick: () => ask() }, label);
  const rest = ({ focus }) => {
    replace(place, button);
    if (focus) button.focus();
  };
  const ask = () => {
    const go = () => (rest({ focus: true }), act());
    const cancel = () => rest({ focus: true });
    askIn(place, label, { words: typeof words === "function" ? words() : words, yes, go, cancel, kind: kind || "primary" });
  };
  rest({ focus: false });
  return { node: place, button, close: () => place.contains(button) || rest({ focus: false }) };
}

/** Puts the question into its place; Cancel has the focus. */
export function askIn(place, label, { words, yes, go, cancel, kind = "primary" }) {
  const no = h("button", { type: "button", onclick: cancel }, t("Cancel"));
  const sure = h("button", { type: "button", class: kind, onclick: go }, yes);
  replace(place, h("div", { class: "question", role: "group", "aria-label": label }, h("p", {}, words), h("div", { class: "row" }, no, sure)));
  no.focus();
}
