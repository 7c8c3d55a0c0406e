/** Passes set by hand: a card for each, in the order in which they are milled. */

import { h, replace } from "../lib/dom.js";
import { PASS } from "./fields.js";
import { row } from "./row.js";

const FIRST = [
  { name: "rough", radius_mm: 3, pitch_mm: 0.5, stock_to_leave_mm: 0.2 },
  { name: "finish", radius_mm: 3, pitch_mm: 0.1 },
];

/** {element, rows(), read(faults), show(passes)}. known(): the passes that would be milled otherwise, where known. */
export function passes({ onChange, known }) {
  let cards = [];
  const list = h("ol", { class: "passes" });
  const add = h("button", { type: "button", onclick: () => change([...values(), { ...FIRST[1] }]) }, "Add a pass");
  const byHand = h("input", { type: "checkbox", onchange: () => change(byHand.checked ? (known() ?? FIRST) : null) });
  const element = h(
    "div",
    { class: "stack" },
    h(
      "label",
      { class: "tick" },
      byHand,
      h("span", {}, "Set every pass by hand", h("small", {}, " (else they follow from how fine it shall be)")),
    ),
    list,
    add,
  );

  function change(rows) {
    show(rows);
    onChange();
    cards[0]?.rows[0].focus();
  }

  function show(rows) {
    byHand.checked = Boolean(rows);
    add.hidden = !rows;
    cards = (rows ?? []).map((values, at) => card(values, at, rows.length));
    replace(
      list,
      cards.map((one) => one.element),
    );
  }

  function card(values, at, count) {
    const rows = PASS.map((field) => row(field, { onChange, key: `passes.${at}.${field.key}` }));
    for (const one of rows) one.show(values[one.field.key] ?? undefined);
    const remove = h(
      "button",
      { type: "button", class: "quiet", disabled: count === 1, onclick: () => without(at) },
      "Remove",
    );
    const title = h("div", { class: "row spread" }, h("h3", {}, `Pass ${at + 1}`), remove);
    return {
      rows,
      element: h(
        "li",
        { class: "card" },
        title,
        h(
          "div",
          { class: "fields" },
          rows.map((one) => one.element),
        ),
      ),
    };
  }

  function without(at) {
    change(values().filter((_, number) => number !== at));
  }

  /** What stands there, as far as it can be read. */
  function values() {
    return read([]) ?? [];
  }

  /** The passes, undefined where they follow from the preset; what cannot be read goes to faults as {row, words}. */
  function read(faults) {
    if (!byHand.checked) return undefined;
    return cards.map(({ rows }) => {
      const pass = {};
      for (const one of rows) {
        try {
          const value = one.read();
          if (value !== undefined) pass[one.field.key] = value;
        } catch (error) {
          faults.push({ row: one, words: error.message });
        }
      }
      return pass;
    });
  }

  show(null);
  return { element, rows: () => cards.flatMap((one) => one.rows), read, show };
}
