/** The figures of a job in words, and its warnings. */
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { sentence } from "../lib/words.js";
import { fold, unfold } from "./fold.js";
import { expertFigures, expertSides, headlines, lightSentence, mainCause } from "./figures.js";
import { predictedLikeness } from "./eye_words.js";

/** {node, update(job)} */
export function factsPart() {
  const list = h("dl", { class: "facts" }), cause = h("p", { class: "dim" });
  const wait = h("p", { class: "dim soon" }, t("Figures appear as the steps finish."));
  const scores = h("div"), light = h("p", { class: "dim" });
  const experts = h("details", { hidden: true }, h("summary", {}, t("Figures for experts")), scores, light, cause);
  const node = fold("expect", t("What to expect"), wait, list, experts);
  let shown = "";

  function update(job) {
    const rows = headlines(job.spec, job.report, predictedLikeness(job)), figures = expertFigures(job.report);
    const key = JSON.stringify([rows, figures]);
    if (key === shown) return;
    shown = key;
    wait.hidden = rows.length > 0;
    replace(list, rows.map(row));
    replace(light, lightSentence(job.report));
    replace(cause, mainCause(job.report));
    experts.hidden = figures.length === 0;
    replace(scores, table(expertSides(job.report).map(([words]) => words), figures));
  }
  return { node, update };
}

function table(sides, figures) {
  const heads = ["", ...sides].map((words) => h(words ? "th" : "td", words && { scope: "col" }, words));
  const rows = figures.map(([what, ...values]) => h("tr", {}, h("th", { scope: "row" }, what), values.map((value) => h("td", {}, value))));
  return h("table", { class: "expert-figures" }, h("thead", {}, h("tr", {}, heads)), h("tbody", {}, rows));
}

function row([what, figure, words]) {
  const value = h("dd", {}, h("strong", {}, figure), words && h("span", { class: "dim" }, words));
  return h("div", {}, h("dt", {}, what), value);
}

/** {node, update(job)}: the report's warnings; nothing if there are none. */
export function warningsPart() {
  const list = h("div", { class: "stack" });
  const node = fold("warnings", t("Look out for"), list);
  let shown = "";
  unfold(node);

  function update(job) {
    const texts = job.report?.warnings ?? [], key = texts.join("\n");
    node.hidden = texts.length === 0;
    if (key === shown) return;
    shown = key;
    const words = (text) => h("span", {}, withCode(sentence(text)));
    replace(list, texts.map((text) => h("p", { class: "notice warn" }, shape("warn"), words(text))));
  }
  return { node, update };
}

/** Shows text between backticks as code. */
function withCode(text) {
  return text.split("`").map((part, k) => (k % 2 ? h("code", {}, part) : part));
}
