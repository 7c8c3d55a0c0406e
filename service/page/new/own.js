/** What a person has: mill, block, finish, lamp, wall, stated once and kept in this browser for every new job. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mm } from "../lib/words.js";
import { valueWords } from "../job/setting_words.js";
import { START, usualOf } from "./fields.js";
import { firstProfile } from "./machines.js";
import { row } from "./row.js";
import { valueOf } from "./screen.js";
import { put, valueAt } from "./spec.js";

export const MACHINE_USUAL = usualOf("machine.profile");
const OWN = "causticmill-own", BLOCK = "causticmill-block"; // of this browser
const OWN_KEYS = ["machine.profile", "stock.thickness_mm", "stock.material", "finish.process", "optics.light", "optics.throw_mm"];
const SIZE = { key: "block", label: t("Length and width of the block"), kind: "numbers", names: [t("length"), t("width")], unit: "mm", usual: null, limits: "" };

/** The usual job, with what the person had in the last one. */
export function startSpec(profiles) {
  const own = JSON.parse(localStorage.getItem(OWN) ?? "{}"), isKnown = profiles.some(({ name }) => name === own["machine.profile"]);
  const spec = structuredClone({ ...START, machine: { profile: firstProfile(profiles, MACHINE_USUAL) } });
  for (const [key, value] of Object.entries(own)) if (isKnown || key !== "machine.profile") put(spec, key, value);
  return spec;
}

/** Keep it; for a job with its own passes, keep only the values that do not depend on the way of planning. */
export function keepOwn(spec) {
  const keys = OWN_KEYS.filter((key) => (key !== "finish.process" || spec.preset === START.preset) && !valueAt(spec, `${key}.profile`));
  localStorage.setItem(OWN, JSON.stringify(Object.fromEntries(keys.map((key) => [key, valueAt(spec, key)]))));
}

/** Length and width of the block that lies there, mm; null if nobody has said. */
export function ownBlock() {
  return JSON.parse(localStorage.getItem(BLOCK) ?? "null");
}

/**
 * {element, update(spec)}: one line that says what the job is made for, which unfolds. rows: of the spec; more: cards of the shop;
 * onBlock(): the block has another size.
 */
export function ownThings({ rows, more, onBlock }) {
  const line = h("span", { class: "dim" }), size = row(SIZE, { onChange: keepSize });
  rows.querySelector("[data-key='stock.thickness_mm']").before(size.element);
  size.show(ownBlock());
  const summary = h("summary", {}, h("span", {}, h("strong", {}, t("What you have")), " ", line));
  const element = h("details", { class: "card fold own", "aria-label": t("What you have"), open: !localStorage.getItem(OWN) }, summary, rows, h("div", { class: "grid shop" }, more));

  function keepSize() {
    try {
      localStorage.setItem(BLOCK, JSON.stringify(size.read() ?? null));
      update(shown);
      onBlock();
    } catch (error) {
      size.blame(error.message);
    }
  }
  const mill = rows.querySelector("select");
  let shown = START;

  function update(spec) {
    shown = spec;
    write(line, [mill.selectedOptions[0].text, ...summaryWords(spec)].join(" · "));
  }
  return { element, update };
}

function summaryWords(spec) {
  const at = (key) => valueOf(spec, key), thick = at("stock.thickness_mm"), block = ownBlock();
  const finish = at("finish.process");
  return [
    block ? t`block ${[...block, thick].join(" × ")} mm` : t`block ${thick} mm thick`,
    valueWords("optics.light.kind", at("optics.light.kind")),
    t`wall at ${mm(at("optics.throw_mm"))}`,
    finish === "none" ? t("not finished by hand") : finish === START.finish.process ? t("finished by hand") : valueWords("finish.process", finish),
  ];
}
