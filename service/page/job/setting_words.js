/** Settings of a job in the words that their fields have in the form of a new one. */
import { t } from "../lib/language.js";
import { passName, within } from "../lib/words.js";
import { PASS, SPEC } from "../new/fields.js";

/** "passes.1.radius_mm" as "ball radius of pass 2 (finish)"; a key without a field unchanged. */
export function settingWords(key, spec) {
  const { pass, own } = splitKey(key), row = rowOf(key), label = row ? within(row.label) : own;
  if (pass === null) return label;
  const name = spec.passes?.[pass]?.name;
  const called = name ? ` (${passName(name)})` : "";
  return label ? t`${label} of pass ${pass + 1}${called}` : t`pass ${pass + 1}${called}`;
}

/** Its value with its unit, or the words of its choice; the default if there is no value. */
export function valueWords(key, value) {
  const row = rowOf(key);
  if (value === undefined || value === null) return typeof row?.usual === "string" ? row.usual : "–";
  const choice = row?.choices?.find(([each]) => each === value);
  if (choice) return choice[1];
  const text = typeof value === "string" ? value : JSON.stringify(value);
  return row?.unit ? `${text} ${row.unit}` : text;
}

/** Whether the form of a new job has its key only among those for experts. */
export function isExpert(key) {
  return !rowOf(key)?.card;
}

function rowOf(key) {
  const { pass, own } = splitKey(key);
  return (pass === null ? SPEC : PASS).find((row) => row.key === own);
}

/** The number of the pass that a key belongs to, or null, and the key within. */
function splitKey(key) {
  const found = /^passes\.(\d+)\.?(.*)$/.exec(key);
  return found ? { pass: Number(found[1]), own: found[2] } : { pass: null, own: key };
}
