/** Two jobs compared: their milled pictures under one wipe, and a table of all differences. */
import { api } from "../lib/api.js";
import { h, replace, sheet } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { capital, hours, jobName, mm, thousands } from "../lib/words.js";
import { ON_THE_WALL, pictureShelf } from "./pictures.js";
import { alikeWords } from "./eye_words.js";
import { millSeconds, passesOf, smallestDetail } from "./figures.js";
import { settingWords, valueWords } from "./setting_words.js";
import { wipe } from "./wipe.js";

export default async function view(root, params, app) {
  const ids = [params.id, params.id2];
  const [sides] = await Promise.all([Promise.all(ids.map(load)), sheet("/page/job/job.css")]);
  const shelf = pictureShelf(), names = tellApart(sides.map(({ job }) => jobName(job)));
  app.title(t`${names[0]} and ${names[1]}`);
  const links = ids.map((id, k) => h("a", { class: "button", href: `#/jobs/${id}` }, names[k]));
  const turn = h("a", { class: "button quiet", href: `#/compare/${ids[1]}/${ids[0]}` }, t("Change sides"));
  replace(
    root,
    h(
      "div", { class: "job-view" },
      h("header", { class: "job-head" }, h("h1", {}, t("Compare")), h("p", { class: "row" }, links, turn)),
      h("div", { class: "job-columns" }, pictures(sides, names, shelf), figures(sides, names)),
      settings(sides, names),
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

function pictures(sides, names, shelf) {
  const both = wipe();
  const kinds = ON_THE_WALL.filter(({ name }) => sides.every(({ artifacts }) => artifacts.has(name))).reverse();
  const title = h("h2", { id: "compare-pictures" }, t("Pictures"));
  const part = (...inner) => h("section", { class: "card stack", "aria-labelledby": "compare-pictures" }, title, inner);
  if (!kinds.length) return part(h("p", {}, t("One of these jobs has no pictures yet.")));
  const show = async (kind) => {
    try {
      const urls = await Promise.all(sides.map(({ artifacts }) => shelf.get(artifacts.get(kind.name))));
      both.show(...urls.map((url, k) => ({ words: names[k], url, alt: `${names[k]}, ${kind.title}: ${kind.note}` })));
    } catch (error) {
      toast(t`The pictures could not be loaded. ${error.detail ?? error.message}`, { kind: "bad" });
    }
  };
  const choice = h(
    "div", { class: "choice", role: "radiogroup", "aria-label": t("Which picture") },
    kinds.map((kind, k) => {
      const input = h("input", { type: "radio", name: "kind", checked: k === 0, onchange: () => show(kind) });
      return h("label", {}, input, h("span", {}, kind.title));
    }),
  );
  show(kinds[0]);
  return part(choice, both.node);
}

/** [name, formatter, better direction: 1 more, -1 less, 0 neither, getter of a job's value] */
const FIGURES = [
  [t("Time on the mill"), hours, -1, ({ job }) => millSeconds(job.report)],
  [t("Smallest detail"), mm, -1, ({ job }) => smallestDetail(job.spec, job.report)],
  [t("On the wall, as milled"), alikeWords, 1, ({ job }) => job.report?.as_milled?.seen_db],
  [t("Likeness (PSNR)"), (value) => `${value.toFixed(1)} dB`, 1, ({ job }) => job.report?.as_milled?.psnr_db],
  [t("Likeness of structure (SSIM)"), (value) => t`${value.toFixed(3)} of 1`, 1, ({ job }) => job.report?.as_milled?.ssim],
  [t("On the wall, if polished"), alikeWords, 1, ({ job }) => job.report?.optics?.seen_db],
  [t("Depth of the lens"), mm, 0, ({ job }) => job.report?.optics?.relief_mm],
  [t("Steepest slope"), (value) => `${value.toFixed(1)}°`, 0, ({ job }) => job.report?.optics?.max_slope_deg],
  [t("Lines of all programs"), thousands, 0, ({ job }) => linesOf(job.report)],
];

function linesOf(report) {
  return report?.passes?.reduce((sum, row) => sum + (row.lines ?? 0), 0);
}

function figures(sides, names) {
  const title = h("h2", { id: "compare-figures" }, t("Figures")), rows = FIGURES.map((figure) => figureRow(figure, sides));
  return h("section", { class: "card", "aria-labelledby": "compare-figures" }, title, table(names, rows, { numbers: true }));
}

/** @param {any[]} figure */
function figureRow([what, say, better, value], sides) {
  const found = sides.map((side) => value(side) ?? null);
  if (found.every((each) => each === null)) return null;
  const texts = found.map((each) => (each === null ? "–" : say(each)));
  const known = better !== 0 && texts[0] !== texts[1] && !found.includes(null);
  const cells = texts.map((text, k) => {
    const wins = known && (found[k] - found[1 - k]) * better > 0;
    return h("td", { class: wins ? "number wins" : "number" }, wins ? winner(text) : text);
  });
  return h("tr", {}, h("th", { scope: "row" }, what), cells);
}

function winner(text) {
  return h("strong", {}, shape("good"), h("span", { class: "hidden-words" }, t("better: ")), ` ${text}`);
}

function settings(sides, names) {
  const cell = (key) => (value) => h("td", {}, valueWords(key, value));
  const named = sides.find(({ job }) => passesOf(job).length)?.job ?? sides[0].job;
  const spec = { ...named.spec, passes: passesOf(named) };
  const seen = ([key, here, there]) => valueWords(key, here) !== valueWords(key, there);
  const rows = differences(...sides.map(({ job }) => specOf(job))).filter(seen).map(([key, ...values]) =>
    h("tr", {}, h("th", { scope: "row" }, capital(settingWords(key, spec))), values.map(cell(key))),
  );
  const title = h("h2", { id: "compare-settings" }, t("Settings that differ"));
  const content = rows.length ? table(names, rows) : h("p", {}, t("None: both were made with the same settings."));
  return h("section", { class: "card", "aria-labelledby": "compare-settings" }, title, content);
}

/** numbers: its columns are figures. */
function table(names, rows, { numbers = false } = {}) {
  const heads = names.map((name) => h("th", { scope: "col", class: numbers ? "number" : null }, name));
  return h("table", { class: "compare-table" }, h("thead", {}, h("tr", {}, h("td"), heads)), h("tbody", {}, rows));
}

function specOf(job) {
  return { picture: job.image.sha256.slice(0, 12), ...job.spec, passes: passesOf(job) };
}

/** [dotted key, value here, value there] of all differences between two values of JSON. */
export function differences(a, b, key = "") {
  const isNested = (value) => value !== null && typeof value === "object";
  if (!isNested(a) || !isNested(b)) return JSON.stringify(a) === JSON.stringify(b) ? [] : [[key, a, b]];
  const keys = [...new Set([...Object.keys(a), ...Object.keys(b)])];
  return keys.flatMap((each) => differences(a[each], b[each], key ? `${key}.${each}` : each));
}
