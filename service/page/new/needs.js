/** What a job needs, each with a tick for what a person has; the rest is the shopping list. Ticks are kept in this browser. */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { capital } from "../lib/words.js";
import { valueWords } from "../job/setting_words.js";
import { ownBlock } from "./own.js";
import { valueOf } from "./screen.js";

const HAVE = "causticmill-have";

/** Fill a section with what this estimate's job needs. */
export function showNeeds(section, estimate) {
  const have = new Set(JSON.parse(localStorage.getItem(HAVE) ?? "[]"));
  const title = h("h3");
  /** @type {{words: string, more?: string, has?: boolean}[]} */
  const rows = [blockOf(estimate), ...cuttersOf(estimate), ...finishOf(estimate)];
  const line = ({ words, more, has }) => {
    const tick = () => (box.checked ? have.add(words) : have.delete(words), localStorage.setItem(HAVE, JSON.stringify([...have])), count());
    const box = h("input", { type: "checkbox", checked: has ?? have.has(words), disabled: has !== undefined, onchange: tick });
    return h("li", {}, h("label", { class: "tick" }, box, h("span", {}, words, more && h("small", {}, more))));
  };
  const count = () => {
    const missing = rows.filter(({ words, has }) => !(has ?? have.has(words))).length;
    write(title, !missing ? t("You have all of it") : missing === rows.length ? t("Shopping list: tick what you have") : t`Shopping list: ${missing} of ${rows.length} to get`);
  };
  count();
  replace(section, title, h("ul", { class: "shopping" }, rows.map(line)));
}

/** The block with its margin and the stock that is faced off; has: whether the person's own is large enough, if its size is stated. */
function blockOf({ spec }) {
  const at = (key) => valueOf(spec, key), around = 2 * at("stock.margin_mm");
  const sides = [at("optics.width_mm") + around, at("optics.height_mm") + around], thick = at("stock.thickness_mm") + (spec.stock?.face?.above_mm ?? 0);
  const words = t`Block ${[...sides, thick].map((side) => +side.toFixed(1)).join(" × ")} mm`;
  const lens = t`lens ${at("optics.width_mm")} × ${at("optics.height_mm")} mm, ${around / 2} mm around it`;
  const own = ownBlock(), ordered = (lengths) => lengths.toSorted((a, b) => a - b);
  const has = own ? ordered(own).every((side, k) => side >= ordered(sides)[k]) : undefined;
  const yours = own && !has ? t`; yours is ${own.join(" × ")} mm` : "";
  return { words, has, more: `${valueWords("stock.material", at("stock.material"))}; ${lens}${yours}` };
}

/** Each once; witness marks are milled by the cutter of the last pass. */
function cuttersOf({ passes }) {
  const sizes = passes.filter(({ name }) => name !== "witness").map(({ tool }) => capital(tool.replace(/R .*\((.*)\)/, "$1").replaceAll(/(?<=Ø) | (?=mm)/g, "\u00a0")));
  return [...new Set(sizes)].map((words) => ({ words }));
}

/** finish: of the chosen plan, where it is planned. */
function finishOf({ spec, finish }) {
  const name = finish?.process ?? valueOf(spec, "finish.process");
  return ["none", "best"].includes(name) ? [] : [{ words: capital(valueWords("finish.process", name)), more: t("the setup sheet lists it piece by piece") }];
}
