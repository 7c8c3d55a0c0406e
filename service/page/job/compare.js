/** Two jobs compared: their walls side by side, and below them only the differences. */
import { api } from "../lib/api.js";
import { h, replace, sheet } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { capital, hours, jobName, mm, passName } from "../lib/words.js";
import { alikeWords } from "./eye_words.js";
import { likenessOf, millSeconds, passesOf, passWords, smallestDetail } from "./figures.js";
import { ON_THE_WALL, pictureShelf } from "./pictures.js";
import { isExpert, settingWords, valueWords } from "./setting_words.js";

export default async function view(root, params, app) {
  const ids = [params.id, params.id2];
  const [sides] = await Promise.all([Promise.all(ids.map(load)), sheet("/page/job/job.css")]);
  const shelf = pictureShelf(), names = tellApart(sides.map(({ job }) => jobName(job)));
  app.title(t`${names[0]} and ${names[1]}`);
  const turn = h("a", { class: "button", href: `#/compare/${ids[1]}/${ids[0]}` }, t("Change sides"));
  replace(
    root,
    h(
      "div", { class: "job-view compare" },
      h("header", { class: "job-head" }, h("h1", {}, t("Compare")), turn),
      h("div", { class: "stage walls-compared" }, sides.map((side, k) => wall(side, names[k], shelf))),
      h("section", { class: "card", "aria-labelledby": "compare-title" }, h("h2", { id: "compare-title" }, t("What differs")), ...differing(sides, names)),
    ),
  );
  return { leave: shelf.free };
}

async function load(id) {
  const address = `/v1/jobs/${encodeURIComponent(id)}`;
  const [job, files] = await Promise.all([api.get(address), api.get(`${address}/artifacts`)]);
  return { job, artifacts: new Map(files.artifacts.map((file) => [file.name, file])) };
}

/** @param {string[]} names */
function tellApart([a, b]) {
  return a === b ? [t`${a} (first)`, t`${b} (second)`] : [a, b];
}

/** The last of a job's pictures of its wall, which is the most realistic. */
function wall({ job, artifacts }, name, shelf) {
  const seen = ON_THE_WALL.findLast(({ name: file }) => artifacts.has(file)), picture = h("img", { alt: seen ? `${name}, ${seen.title}: ${seen.note}` : "" });
  if (seen) shelf.get(artifacts.get(seen.name)).then((url) => (picture.src = url), () => {});
  return h("figure", {}, picture, h("figcaption", {}, h("a", { href: `#/jobs/${job.id}` }, name), " ", h("small", {}, seen?.title ?? t("It has no pictures yet."))));
}

/** [name, formatter, better direction: 1 more, -1 less, 0 neither, getter of a job's value] */
const FIGURES = [
  [t("Time on the mill"), hours, -1, ({ report }) => millSeconds(report)],
  [t("Work by hand"), (minutes) => (minutes ? hours(60 * minutes) : t("none")), -1, ({ report }) => report && (report.finishing?.minutes ?? 0)],
  [t("Smallest detail"), mm, -1, ({ spec, report }) => smallestDetail(spec, report)],
  [t("On the wall"), alikeWords, 1, ({ report }) => likenessOf(report?.as_finished) ?? likenessOf(report?.as_milled)],
  [t("Depth of the lens"), mm, 0, ({ report }) => report?.optics?.relief_mm],
];

const SAID = "finish.minutes"; // by a figure

/** The figures and settings that differ, in a table; those for experts, and the keys of passes, which a line already states, are folded. */
function differing(sides, names) {
  const jobs = sides.map(({ job }) => job), passes = jobs.map(passesOf);
  const figures = FIGURES.map((figure) => figureRow(figure, jobs)).filter(Boolean);
  const named = jobs.find((job) => passesOf(job).length) ?? jobs[0], spec = { ...named.spec, passes: passesOf(named) };
  const line = ([key, ...values]) => row(capital(settingWords(key, spec)), values.map((value) => valueWords(key, value)));
  const seen = ([key, here, there]) => key !== SAID && valueWords(key, here) !== valueWords(key, there);
  const all = differences(...jobs.map(specOf)).filter(seen), forExperts = all.filter(([key]) => isExpert(key));
  const most = Math.max(...passes.map(({ length }) => length));
  const inWords = Array.from({ length: most }, (_, k) => {
    const each = passes.map((list) => list[k]), texts = each.map((pass) => (pass ? passWords(pass) : "–"));
    return texts[0] !== texts[1] && row(t`Pass ${k + 1} (${passName(each.find(Boolean).name)})`, texts);
  });
  const rows = [...figures, ...all.filter((one) => !forExperts.includes(one)).map(line), ...inWords].filter(Boolean);
  return [
    rows.length > 0 || forExperts.length > 0 ? table(names, rows) : h("p", {}, t("Nothing: both were made with the same settings.")),
    forExperts.length > 0 && h("details", {}, h("summary", {}, t("Every setting that differs")), table(names, forExperts.map(line))),
  ].filter(Boolean);
}

/** @param {any[]} figure */
function figureRow([what, say, better, value], jobs) {
  const found = jobs.map((job) => value(job) ?? null);
  const texts = found.map((each) => (each === null ? "–" : say(each)));
  if (texts[0] === texts[1]) return null;
  const known = better !== 0 && !found.includes(null);
  return row(what, texts.map((text, k) => (known && (found[k] - found[1 - k]) * better > 0 ? winner(text) : text)));
}

function winner(text) {
  return h("strong", { class: "wins" }, shape("good"), h("span", { class: "hidden-words" }, t("better: ")), ` ${text}`);
}

function row(what, cells) {
  return h("tr", {}, h("th", { scope: "row" }, what), cells.map((cell) => h("td", {}, cell)));
}

function table(names, rows) {
  const heads = names.map((name) => h("th", { scope: "col" }, name));
  return h("table", { class: "compare-table" }, h("thead", {}, h("tr", {}, h("td"), heads)), h("tbody", {}, rows));
}

function specOf(job) {
  return { ...job.spec, passes: passesOf(job) };
}

/** [dotted key, value here, value there] of all differences between two values of JSON. */
export function differences(a, b, key = "") {
  const isNested = (value) => value !== null && typeof value === "object";
  if (!isNested(a) || !isNested(b)) return JSON.stringify(a) === JSON.stringify(b) ? [] : [[key, a, b]];
  const keys = [...new Set([...Object.keys(a), ...Object.keys(b)])];
  return keys.flatMap((each) => differences(a[each], b[each], key ? `${key}.${each}` : each));
}
