/** A line under a group of controls with the reason why the last order was refused. */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { refusalOf } from "./words.js";

export function refusalLine() {
  const node = h("div", { class: "said", role: "status" });
  return {
    node,
    /** Run an order and show in sight why it was refused, until the next one. True if it was accepted. */
    async run(order) {
      write(node, "");
      node.classList.remove("bad");
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
