/**
 * The keys of the job spec as rows of the form, from the JSON schema by which the server checks a spec. A new key gets
 * its row without a change here; the words of the row stand beside the key (service/job/spec/section.py).
 *
 * A row is {key, label, kind, usual} and more. kind: "number", "whole" (number), "choice", "tick", "text", or "numbers"
 * (one for each of `names`). usual: the value if the field is empty; a text if the server computes it. hint,
 * unit, limits: words. choices: [value, words, sentence]. when(spec): the row is shown only then. The others are those
 * of `FieldLook` in that file.
 */

import { t } from "../lib/language.js";
import { SCHEMA } from "./spec_schema.js";
import { valueAt } from "./spec.js";

const KINDS = { boolean: "tick", integer: "whole", number: "number", string: "text" };
const YES_NO = [
  { const: true, title: t("yes") },
  { const: false, title: t("no") },
];

/** The job that page and commands begin with. */
export const START = SCHEMA.default;

/** All but those of the passes. */
export const SPEC = [...rowsOf(SCHEMA)];

const on = (card) => SPEC.filter((row) => row.card === card).sort((one, other) => Number(Boolean(other.first)) - Number(Boolean(one.first)));
export const [MAIN, LIGHT, MILL, PICTURE] = ["main", "light", "mill", "picture"].map(on);

/** [title, rows] of the folded part: all rows without a card. */
const FOLDED = SPEC.filter(({ card }) => !card);
export const EXPERT = [...new Set(FOLDED.map(({ table }) => table))].map((title) => [
  title,
  FOLDED.filter(({ table }) => table === title),
]);

/** The figures of one pass, in the order of its card. */
export const PASS = [...rowsOf(target(SCHEMA.properties.passes.items))];

/** The value of a key of the spec that is left out. */
export function usualOf(key) {
  return SPEC.find((row) => row.key === key).usual;
}

/** Rows of a table and of those in it. Lists of lists and of tables have none: they are other values, as JSON.
 * @param {any} table @param {{before?: string, title?: string}} within */
function* rowsOf(table, { before = "", title } = {}) {
  for (const [name, schema] of Object.entries(table.properties)) {
    const inner = target(schema), key = before + name;
    if (inner.properties && !isOptional(schema)) yield* rowsOf(inner, { before: `${key}.`, title: title ?? say(schema.title) });
    else if (kindOf(schema, inner)) yield { ...rowOf(key, schema, inner), table: title ?? t("Job") };
  }
}

/** A text of the schema, which may be none. */
function say(words) {
  return words && t(words);
}

/** The target of a reference; of "this or null", this. */
function target(schema) {
  const one = schema.anyOf?.find(({ type }) => type !== "null") ?? schema;
  return one.$ref ? SCHEMA.$defs[one.$ref.split("/").at(-1)] : one;
}

function isOptional(schema) {
  return Boolean(schema.anyOf?.some(({ type }) => type === "null"));
}

function kindOf(schema, inner) {
  if (choicesOf(schema, inner).length) return "choice";
  if (inner.type === "array") return inner.items.type === "number" && inner.minItems === inner.maxItems ? "numbers" : null;
  return KINDS[inner.type] ?? null;
}

/** [value, words, sentence]: those with words first, then the other allowed values, including "nothing" if it is allowed. */
function choicesOf(schema, inner) {
  const worded = schema.form?.choices ?? schema.oneOf ?? (inner.type === "boolean" && isOptional(schema) ? YES_NO : []);
  const others = (inner.enum ?? []).filter((value) => !worded.some((one) => one.const === value));
  const rows = [...worded, ...others.map((value) => ({ const: value }))];
  const choices = rows.map(({ const: value, title, description }) => [value, say(title ?? String(value)), say(description)]);
  return rows.length && isOptional(schema) ? [[null, say(schema.form?.usual ?? "usual")], ...choices] : choices;
}

function rowOf(key, schema, inner) {
  const { choices: _, usual, when, ...look } = schema.form ?? {};
  const kind = kindOf(schema, inner), standard = schema.default ?? null;
  const names = Array.from({ length: inner.minItems ?? 0 }, (_, at) => String(at + 1));
  return {
    ...look,
    names: (look.names ?? names).map(say),
    key,
    label: say(schema.title),
    kind,
    hint: say(schema.description),
    unit: schema.unit ?? "",
    limits: limitsOf(inner, schema.unit),
    usual: standard ?? (["choice", "numbers"].includes(kind) ? null : say(usual ?? "needed")),
    choices: choicesOf(schema, inner),
    when: when && ((spec) => Object.entries(when).every(([other, values]) => [values].flat().includes(valueAt(spec, other) ?? usualOf(other)))),
  };
}

/** "0.5 to 2000 mm" */
function limitsOf({ minimum, maximum }, unit = "") {
  return maximum === undefined ? "" : `${t`${minimum} to ${maximum}`} ${unit}`.trim();
}
