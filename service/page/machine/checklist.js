/** What a person looks at before the mill moves: every tick is given anew, each time, by name. */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { enable } from "./said.js";
import { checkWords } from "./words.js";

/**
 * Ticks for `run.required_checks`, the operator's name, and the button that is on when nothing is missing.
 * act({operator, checks}) gives the order.
 */
export function checklist(run, { label, act }) {
  const boxes = run.required_checks.map((check) => ({ check, box: h("input", { type: "checkbox", onchange: () => count() }) }));
  const operator = h("input", { type: "text", maxLength: 100, autocomplete: "name", value: api.who.paired ? api.who.name : "", oninput: () => count() });
  const go = h("button", { type: "button", class: "big primary go", onclick: () => act({ operator: operator.value.trim(), checks: boxes.map(({ check }) => check) }) }, label);
  const missing = h("p", { class: "missing", role: "status" });
  let why = "";
  const count = () => {
    const left = boxes.filter(({ box }) => !box.checked).length;
    const named = operator.value.trim() !== "";
    const words = left ? `${left} of ${boxes.length} still to tick.` : named ? "" : "Give your name.";
    enable([go], why === "" && words === "");
    write(missing, why || words);
  };
  count();
  const node = h(
    "div",
    { class: "checklist" },
    h("fieldset", {}, h("legend", {}, "Look, then tick"), boxes.map(({ check, box }) => line(check, box, run))),
    h("label", { class: "field" }, h("span", {}, "Operator"), operator),
    go,
    missing,
  );
  return {
    node,
    /** words: why the order cannot be given now; "" where it can. */
    update(words) {
      why = words;
      count();
    },
    /** The mill has moved since: what was looked at may not be so any more. */
    clear() {
      for (const { box } of boxes) box.checked = false;
      count();
    },
  };
}

function line(check, box, run) {
  const [words, more] = checkWords(check, run);
  return h("label", { class: "tick" }, box, h("span", {}, words, more && h("small", {}, more)));
}
