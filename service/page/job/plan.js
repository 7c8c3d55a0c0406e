/** Hours against sharpness: every useful plan as a point that a person can choose. */
import { h, replace, svg } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { hours, mm, passName, sentence } from "../lib/words.js";
import { eyeWords } from "./eye_words.js";
import { fold } from "./fold.js";
import { detailOfPlan, passWords } from "./figures.js";

const EDGE = { left: 58, right: 16, top: 28, bottom: 54 };
const HEIGHT = 300;
const LEAST_WIDTH = 240;
const MARKS_H = [1 / 60, 2 / 60, 5 / 60, 10 / 60, 0.25, 0.5, 1, 2, 3, 5, 8, 12, 24, 48, 96, 200];

/** {node, update(job)} */
export function planPart() {
  const chart = h("div", { class: "plan-chart" }), chosen = h("div", { class: "plan-chosen", "aria-live": "polite" });
  const why = h("details", {}, h("summary", {}, t("Why this plan was made")), h("div", { class: "plan-why" }));
  const words = t("Each point is a way to mill this lens: more hours, sharper picture. Take one to see what it means.");
  const intro = h("p", { class: "dim" }, words);
  const body = h("div", { class: "plan-body" }, chart, chosen);
  const node = fold("plan", t("Hours against sharpness"), intro, body, why);
  let shown = "", taken = 0, job = null, plan = null, rows = [];

  function update(next) {
    job = next;
    plan = job.report?.plan;
    rows = plan?.candidates?.filter((row) => row.spec) ?? [];
    node.hidden = rows.length === 0;
    const key = JSON.stringify(plan);
    if (node.hidden || key === shown) return;
    shown = key;
    const reasons = plan.why ?? [], isSaid = (one) => reasons.some((text) => text.includes(one.tool) && text.includes(one.why));
    const left = (plan.left_out ?? []).filter((one) => !isSaid(one)).map((one) => t`Left out: ${one.tool}, ${one.why}.`);
    replace(why.lastChild, [...reasons, ...left].map((text) => h("p", {}, text)));
    take(plan.chosen);
  }
  function draw() {
    const width = Math.max(LEAST_WIDTH, chart.clientWidth), at = scales(rows, width);
    const held = chart.contains(document.activeElement);
    replace(chart, drawing(rows, at, width, { taken, made: plan.chosen, take, spec: job.spec }));
    if (held) chart.querySelector("[aria-checked=true]").focus();
  }
  function take(k) {
    taken = Math.min(rows.length - 1, Math.max(0, k));
    draw();
    replace(chosen, steps(rows.length, taken, take), inWords(job, rows[taken], taken, plan.chosen));
  }
  const watch = new ResizeObserver(() => rows.length && !node.hidden && draw());
  watch.observe(chart);
  return { node, update, free: () => watch.disconnect() };
}

/** Buttons for the previous and the next plan, for people who cannot hit a point. */
function steps(count, taken, take) {
  return h(
    "div", { class: "plan-steps" },
    h("button", { type: "button", disabled: taken === 0, onclick: () => take(taken - 1) }, t("Quicker")),
    h("button", { type: "button", disabled: taken === count - 1, onclick: () => take(taken + 1) }, t("Sharper")),
  );
}

/** Places on a chart so many pixels wide: x by the logarithm of hours, y by dB, from `least` to `most`. */
export function scales(rows, width) {
  const logs = rows.map((row) => Math.log(row.hours)), levels = rows.map((row) => row.psnr_db);
  const [x0, x1] = spread(logs, Math.log(2)), [y0, y1] = spread(levels, 2);
  return {
    x: (value) => EDGE.left + ((Math.log(value) - x0) / (x1 - x0)) * (width - EDGE.left - EDGE.right),
    y: (value) => HEIGHT - EDGE.bottom - ((value - y0) / (y1 - y0)) * (HEIGHT - EDGE.top - EDGE.bottom),
    least: y0,
    most: y1,
    hours: MARKS_H.filter((each) => Math.log(each) >= x0 && Math.log(each) <= x1),
    levels: Array.from({ length: Math.floor(y1) - Math.ceil(y0) + 1 }, (_, k) => Math.ceil(y0) + k),
  };
}

/** The range of the values with some room at both ends, and at least `least` wide. */
function spread(values, least) {
  const low = Math.min(...values), high = Math.max(...values), span = Math.max(high - low, least);
  const middle = (low + high) / 2;
  return [middle - 0.58 * span, middle + 0.58 * span];
}

function drawing(rows, at, width, { taken, made, take, spec }) {
  const every = Math.ceil(at.levels.length / 7), floor = HEIGHT - EDGE.bottom;
  const hoursShown = spaced(at.hours.map((each) => [each, at.x(each)]), 64);
  const line = rows.map((row, k) => `${k ? "L" : "M"}${at.x(row.hours).toFixed(1)} ${at.y(row.psnr_db).toFixed(1)}`).join("");
  const nearest = (event) => {
    const box = event.currentTarget.getBoundingClientRect(), x = event.clientX - box.left, y = event.clientY - box.top;
    const off = rows.map((row) => Math.hypot(at.x(row.hours) - x, at.y(row.psnr_db) - y));
    take(off.indexOf(Math.min(...off)));
  };
  return svg(
    "svg", {
      viewBox: `0 0 ${width} ${HEIGHT}`, height: HEIGHT, class: "plan-svg", role: "radiogroup",
      "aria-label": t("Plans, quickest first"), onclick: nearest,
    },
    at.levels.filter((_, k) => k % every === 0).map((level) => [
      svg("path", { class: "plan-grid", d: `M${EDGE.left} ${at.y(level).toFixed(1)}H${width - EDGE.right}` }),
      svg("text", { class: "plan-mark", x: EDGE.left - 8, y: at.y(level) + 4, "text-anchor": "end" }, `${level} dB`),
    ]),
    hoursShown.map(([each, x]) => [
      svg("path", { class: "plan-grid", d: `M${x.toFixed(1)} ${EDGE.top}V${floor}` }),
      svg("text", { class: "plan-mark", x, y: floor + 18, "text-anchor": "middle" }, hours(each * 3600)),
    ]),
    svg("text", { class: "plan-axis", x: (EDGE.left + width) / 2, y: HEIGHT - 8, "text-anchor": "middle" }, t("time on the mill")),
    svg("text", { class: "plan-axis", x: 0, y: 14 }, t("likeness of the milled picture")),
    svg("path", { class: "plan-line", d: line }),
    rows.map((row, k) => point(row, k, at, { taken, made, take, spec, last: rows.length - 1 })),
  );
}

/** Those of [value, place] that lie far enough apart for their words not to overlap. */
function spaced(marks, least) {
  return marks.reduce((kept, one) => (kept.length && one[1] - kept.at(-1)[1] < least ? kept : [...kept, one]), []);
}

function point(row, k, at, { taken, made, take, spec, last }) {
  const keys = { ArrowRight: k + 1, ArrowUp: k + 1, ArrowLeft: k - 1, ArrowDown: k - 1, Home: 0, End: last };
  const x = at.x(row.hours), y = at.y(row.psnr_db), own = k === taken;
  const blur = t`details under ${mm(detailOfPlan(spec, row))} will blur`, ours = k === made ? t(", this job's plan") : "";
  const words = `${hours(row.hours * 3600)}, ${blur}, ${eyeWords(row.seen_db)}, ${row.psnr_db.toFixed(1)} dB${ours}`;
  return svg(
    "g", {
      class: `plan-point${own ? " taken" : ""}`, role: "radio", tabindex: own ? 0 : -1,
      "aria-checked": String(own), "aria-label": words,
      onkeydown: (event) => {
        if (!(event.key in keys) && event.key !== " ") return;
        event.preventDefault();
        take(keys[event.key] ?? k);
      },
    },
    svg("circle", { class: "plan-touch", cx: x, cy: y, r: 22 }),
    k === made
      ? svg("rect", { class: "plan-dot", x: x - 7, y: y - 7, width: 14, height: 14, rx: 2 })
      : svg("circle", { class: "plan-dot", cx: x, cy: y, r: 7 }),
    svg("title", {}, words),
  );
}

function inWords(job, row, k, made) {
  const passes = row.spec.passes ?? [], own = k === made;
  return [
    h("h3", {}, t`${hours(row.hours * 3600)}: details under ${mm(detailOfPlan(job.spec, row))} will blur`),
    h("p", {}, t`On the wall: ${eyeWords(row.seen_db)} `, h("small", { class: "dim" }, `(${row.psnr_db.toFixed(1)} dB)`)),
    row.warning && h("p", { class: "notice warn" }, shape("warn"), h("span", {}, sentence(row.warning))),
    h("ol", { class: "plan-passes" }, passes.map((pass, n) => passRow(pass, row.hours_by_pass?.[n]))),
    own
      ? h("p", { class: "dim" }, t("This is the plan of this job, predicted before the programs were written; what they will do is under “What to expect”."))
      : h("a", { class: "button primary", href: `#/new?from=${job.id}&plan=${k}` }, t("Make this job")),
  ];
}

function passRow(pass, inHours) {
  return h("li", {}, h("strong", {}, passName(pass.name)), ": ", passWords(pass), inHours ? `, ${hours(inHours * 3600)}` : "");
}
