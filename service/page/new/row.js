/** One row of the form: label, input, hint, and the fault beside it. */

import { freshId, h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isTable, numberOf } from "./spec.js";

/**
 * {element, key, field, read(), show(value), blame(words, use), disable(why), focus()}; a select has offer(value, on), too.
 * read() gives the value, undefined for the usual one; TypeError, with a message for the person, if it is not a value.
 * show(undefined) shows the usual. onChange() is called on every change a person makes.
 */
export function row(field, { onChange, key = field.key }) {
  const ids = { label: freshId("label"), hint: freshId("hint"), fault: freshId("fault") };
  const described = `${field.hint ? `${ids.hint} ` : ""}${ids.fault}`;
  const changed = () => {
    blame(""); // until the server has checked it again
    onChange();
  };
  const input = INPUTS[field.kind](field, { ids, described, onChange: changed });
  const fault = h("p", { class: "fault", id: ids.fault });
  const hint = field.hint && h("small", { id: ids.hint }, field.hint);
  const element = h(
    "div",
    { class: input.group || field.wide ? "field wide" : "field", dataset: { key }, role: input.group ? "group" : null, "aria-labelledby": input.group ? ids.label : null },
    labelled(field, input, ids),
    hint,
    fault,
  );

  /** use: a valid value, which one click takes over. */
  function blame(words, use) {
    const take = () => (input.show(use), changed());
    replace(fault, words, use != null && h("button", { type: "button", onclick: take }, t`Use ${use} ${field.unit}`));
    for (const control of input.controls) control.setAttribute("aria-invalid", String(Boolean(words)));
  }

  /** why: the reason why it cannot be set, "" if it can. */
  function disable(why) {
    for (const control of input.controls) Object.assign(control, { disabled: why !== "", title: why || field.limits });
  }

  return { element, key, field, read: input.read, show: input.show, offer: input.offer, blame, disable, focus: () => input.controls[0].focus() };
}

/** The value of a row; an unreadable one goes to faults as {row, words}. */
export function readRow(row, faults) {
  try {
    return row.read();
  } catch (error) {
    faults.push({ row, words: error.message });
    return undefined;
  }
}

/** The input with its label: around a tick, before a single input, as the name of a group. */
function labelled(field, input, ids) {
  if (field.kind === "tick")
    return h("label", { class: "tick" }, input.element, h("span", { id: ids.label }, field.label));
  const label = input.group
    ? h("span", { id: ids.label }, field.label)
    : h("label", { id: ids.label, for: input.id }, field.label);
  return [label, input.element];
}

const INPUTS = {
  number: (field, parts) => oneNumber(field, parts),
  whole: (field, parts) => oneNumber(field, parts, { whole: true }),
  text: oneText,
  json: oneTable,
  tick: oneTick,
  choice: (field, parts) => (field.look === "cards" ? cards(field, parts) : select(field, parts)),
  numbers: severalNumbers,
};

function textInput(field, { described, onChange }, more) {
  return h("input", {
    type: "text",
    autocomplete: "off",
    placeholder: String(field.usual ?? t("the machine's")),
    title: field.limits || null,
    "aria-describedby": described,
    oninput: onChange,
    ...more,
  });
}

function numberInput(field, parts, more) {
  return textInput(field, parts, { inputMode: "decimal", onfocus: selectAll, ...more });
}

/** Typing replaces the number in the field, even after a click that would set the cursor. */
function selectAll({ target }) {
  target.select();
  target.addEventListener("mouseup", (event) => event.preventDefault(), { once: true });
}

function withUnit(input, unit) {
  return unit ? h("span", { class: unit.length > 3 ? "with-unit long" : "with-unit" }, input, h("span", {}, unit)) : input;
}

function readNumber(input, { whole = false } = {}) {
  if (!input.value.trim()) return undefined;
  const value = numberOf(input.value);
  if (!Number.isFinite(value)) throw new TypeError(t`'${input.value.trim()}' is not a number.`);
  if (whole && !Number.isInteger(value)) throw new TypeError(t`${value} is not a whole number.`);
  return value;
}

function oneNumber(field, parts, options) {
  const id = freshId("input");
  const input = numberInput(field, parts, { id });
  const show = (value) => {
    input.value = value ?? (field.filled ? field.usual : "");
  };
  show(undefined);
  return {
    id,
    element: withUnit(input, field.unit),
    controls: [input],
    read: () => readNumber(input, options),
    show,
  };
}

function severalNumbers(field, parts) {
  const inputs = field.names.map((name, at) =>
    numberInput({ ...field, usual: field.usual?.[at] ?? name }, parts, {
      "aria-label": `${field.label} ${name}${field.unit ? `, ${field.unit}` : ""}`,
    }),
  );
  const read = () => {
    const values = inputs.map((input) => readNumber(input));
    if (values.every((value) => value === undefined)) return undefined;
    if (values.some((value) => value === undefined)) throw new TypeError(t("Fill in all of them, or none."));
    return values;
  };
  const show = (values) => inputs.forEach((input, at) => (input.value = values?.[at] ?? ""));
  const unit = field.unit ? h("span", { class: "dim" }, field.unit) : null;
  return { element: h("div", { class: "several" }, inputs, unit), controls: inputs, group: true, read, show };
}

function oneText(field, parts) {
  const id = freshId("input"), input = textInput(field, parts, { id });
  return { id, element: input, controls: [input], read: () => input.value.trim() || undefined, show: (value) => (input.value = value ?? "") };
}

/** A table of JSON as a text of several lines. */
function oneTable(_, { described, onChange }) {
  const id = freshId("input");
  const input = h("textarea", { id, rows: 3, spellcheck: false, class: "mono", "aria-describedby": described, oninput: onChange });
  function read() {
    if (!input.value.trim()) return undefined;
    let value;
    try {
      value = JSON.parse(input.value);
    } catch (error) {
      throw new TypeError(t`This is not JSON: ${error.message}`);
    }
    if (!isTable(value)) throw new TypeError(t("This must be an object in braces: {...}"));
    return value;
  }
  return { id, element: input, controls: [input], read, show: (value) => (input.value = value ? JSON.stringify(value, null, 1) : "") };
}

function oneTick(field, { ids, described, onChange }) {
  const input = h("input", {
    type: "checkbox",
    "aria-labelledby": ids.label,
    "aria-describedby": described,
    onchange: onChange,
  });
  const show = (value) => {
    input.checked = value ?? field.usual;
  };
  show(undefined);
  return {
    element: input,
    controls: [input],
    read: () => (input.checked === field.usual ? undefined : input.checked),
    show,
  };
}

function select(field, { described, onChange }) {
  const id = freshId("input");
  const values = field.choices.map(([value]) => value), options = field.choices.map(([, words], at) => h("option", { value: String(at) }, words));
  const input = h(
    "select",
    { id, "aria-describedby": described, onchange: onChange },
    grouped(field.choices.map(([, , , group], at) => [group, options[at]])),
  );
  const more = h("small");
  const showWords = () => write(more, field.choices[Number(input.value)]?.[2] ?? "");
  input.addEventListener("change", showWords);
  const show = (value) => {
    input.value = String(values.indexOf(value ?? field.usual));
    showWords();
  };
  const read = () => {
    const value = values[Number(input.value)];
    return value === field.usual ? undefined : value;
  };
  const offer = (value, on) => (options[values.indexOf(value)].hidden = !on);
  show(undefined);
  return { id, element: h("div", { class: "chosen" }, input, more), controls: [input], read, show, offer };
}

/** Options under the names of their groups, where they have any. */
function grouped(options) {
  const groups = [...new Set(options.map(([group]) => group))];
  const own = (name) => options.filter(([group]) => group === name).map(([, option]) => option);
  return groups.map((name) => (name ? h("optgroup", { label: name }, own(name)) : own(name)));
}

function cards(field, { described, onChange }) {
  const name = freshId("choice");
  const inputs = field.choices.map(([value]) =>
    h("input", { type: "radio", name, value, "aria-describedby": described, onchange: onChange }),
  );
  const show = (value) => {
    for (const input of inputs) input.checked = input.value === (value ?? field.usual);
  };
  const read = () => {
    const value = inputs.find((input) => input.checked)?.value;
    return value === field.usual ? undefined : value;
  };
  show(undefined);
  const labels = field.choices.map(([, words, more], at) =>
    h("label", {}, inputs[at], h("span", {}, words, h("small", {}, more))),
  );
  return { element: h("div", { class: "choice" }, labels), controls: inputs, group: true, read, show };
}
