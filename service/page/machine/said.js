/** A line under a group of controls that says why they are off, or what the mill answered to the last order. */

import { h, write } from "../lib/dom.js";

export function said() {
  const node = h("p", { class: "said", role: "status" });
  let refusal = "";
  return {
    node,
    /** Runs an order and shows what it was refused for. True where it was taken. */
    async during(order) {
      refusal = "";
      node.classList.remove("bad");
      try {
        await order();
        return true;
      } catch (error) {
        if (error.name === "AbortError") return false;
        refusal = error.detail ?? error.message;
        write(node, refusal);
        node.classList.add("bad");
        return false;
      }
    },
    /** Why the controls are off; "" where they are not: then the last refusal stays. */
    why(words) {
      if (words) {
        refusal = "";
        node.classList.remove("bad");
      }
      write(node, words || refusal);
    },
  };
}

/** Switches controls on or off; one that has the focus keeps it. */
export function enable(controls, on) {
  for (const control of controls) {
    if (control.disabled === on) control.disabled = !on;
  }
}
