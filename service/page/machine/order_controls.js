/**
 * Parts beside controls that give orders: a line with the reason why the last order was refused, and a question in
 * place of the control, because a dialog would lie over HOLD and STOP. guardedButton("Unlock", {words, yes, act}) is a
 * button that becomes the question; the harmless answer has the focus.
 */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { refusalOf } from "./words.js";

export function refusalLine() {
  const node = h("div", { class: "said", role: "status" });
  const clear = () => (write(node, ""), node.classList.remove("bad"));
  return {
    node,
    clear,
    /** Run an order; if it is refused, show the reason in view until the next one. True if it was accepted. */
    async run(order) {
      clear();
      try {
        await order();
        return true;
      } catch (error) {
        const { brief, whole, parts = [] } = refusalOf(error);
        if (parts.length) replace(node, brief, h("details", {}, h("summary", {}, t("Where")), h("ul", {}, parts.map((part) => h("li", {}, part)))));
        else write(node, whole);
        node.classList.add("bad");
        node.scrollIntoView({ block: "nearest" }); // the bars over the page keep their distance by scroll-padding
        return false;
      }
    },
  };
}

/** Switches controls on or off; one that has the focus keeps it. */
export function enable(controls, on) {
  for (const control of controls) {
    if (control.disabled === on) control.disabled = !on;
  }
}

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
