/**
 * A question in its place on the screen, because a dialog would lie over HOLD and STOP.
 *
 * guarded("Unlock", {words, yes, act}) is a button that becomes the question; the harmless answer has the focus.
 */

import { h, replace } from "../lib/dom.js";

export function guarded(label, { words, yes, act, kind = "" }) {
  const place = h("div", { class: "ask" });
  const button = h("button", { type: "button", class: kind, onclick: () => ask() }, label);
  const rest = ({ focus }) => {
    replace(place, button);
    if (focus) button.focus();
  };
  const ask = () => {
    const no = h("button", { type: "button", onclick: () => rest({ focus: true }) }, "Cancel");
    const go = () => (rest({ focus: true }), act());
    const question = typeof words === "function" ? words() : words;
    replace(place, h("div", { class: "question", role: "group", "aria-label": label }, h("p", {}, question), h("div", { class: "row" }, no, h("button", { type: "button", class: kind || "primary", onclick: go }, yes))));
    no.focus();
  };
  rest({ focus: false });
  return { node: place, button, close: () => place.contains(button) || rest({ focus: false }) };
}
