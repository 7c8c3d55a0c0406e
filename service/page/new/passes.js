/** Passes set by hand: a card for each, in the order in which they are milled. */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { PASS } from "./fields.js";
import { readRow, row } from "./row.js";

export const FIRST = [
  { name: "rough", radius_mm: 3, pitch_mm: 0.5, stock_to_leave_mm: 0.2 },
  { name: "finish", radius_mm: 3, pitch_mm: 0.1 },
];

/** {key, element, rows(), read(faults), show(passes)}. known(): the passes that would be milled without them, if known. */
export function passes({ onChange, known }) {
  let cards = [];
  const list = h("ol", { class: "passes" });
  const add = h("button", { type: "button", onclick: () => change([...values(), another()], values().length) }, t("Add a pass"));
  const byHand = h("input", { type: "checkbox", onchange: () => change(byHand.checked ? known() : null) });
  const words = h("span", {}, t("Set every pass by hand"), h("small", {}, t(" (otherwise they follow from “How fine”)")));
  const element = h("div", { class: "stack" }, h("label", { class: "tick field" }, byHand, words), list, add);

  /** focus: number of the pass that the person is editing. */
  function change(rows, focus = 0) {
    show(rows);
    onChange();
    cards[focus]?.rows[0].focus();
  }

  /** A copy of the last pass with a name of its own. */
  function another() {
    const all = values(), last = all.at(-1);
    const stem = (last.name ?? FIRST[1].name).replace(/-\d+$/, "");
    return { ...last, name: `${stem}-${all.length + 1}` };
  }

  function show(rows) {
    byHand.checked = Boolean(rows);
    add.hidden = !rows;
    cards = (rows ?? []).map((values, at) => card(values, at, rows.length));
    replace(list, cards.map((one) => one.element));
  }

  function card(values, at, count) {
    const rows = PASS.map((field) => row(field, { onChange, key: `passes.${at}.${field.key}` }));
    for (const one of rows) one.show(values[one.field.key] ?? undefined);
    const remove = h("button", { type: "button", class: "quiet", disabled: count === 1, onclick: () => without(at) }, t("Remove"));
    const title = h("h3", { tabIndex: -1 }, t`Pass ${at + 1}`);
    const fault = h("p", { class: "fault", role: "alert" });
    const fields = h("div", { class: "fields" }, rows.map((one) => one.element));
    const element = h("li", { class: "card" }, h("div", { class: "row spread" }, title, remove), fault, fields);
    return { rows, whole: wholePass(`passes.${at}`, { element, title, fault }), element };
  }

  function without(at) {
    change(values().filter((_, number) => number !== at), Math.max(0, at - 1));
  }

  /** The values in the fields, as far as they can be read. */
  function values() {
    return read([]) ?? [];
  }

  /** The passes, undefined if they follow from the preset; unreadable values go to faults as {row, words}. */
  function read(faults) {
    if (!byHand.checked) return undefined;
    return cards.map(({ rows }) => {
      const pass = {};
      for (const one of rows) {
        const value = readRow(one, faults);
        if (value !== undefined) pass[one.field.key] = value;
      }
      return pass;
    });
  }

  show(null);
  return { key: "passes", element, rows: () => cards.flatMap((one) => [one.whole, ...one.rows]), read, show };
}

/** Show a fault of a whole pass at its head, like that of a row. */
function wholePass(key, { element, title, fault }) {
  return { key, field: { label: title.textContent }, element, blame: (words) => write(fault, words ?? ""), focus: () => title.focus() };
}
