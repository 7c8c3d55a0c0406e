/** A line under a group of controls that says what the last order was refused for. */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { refusalOf } from "./words.js";

export function refusalLine() {
  const node = h("div", { class: "said", role: "status" });
  return {
    node,
    /** Runs an order and shows what it was refused for, in sight, until the next one. True where it was taken. */
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
