/** The state of a job or run as a word and a shape; the colour only adds to them. */

import { h, svg } from "./dom.js";
import { t } from "./language.js";

const LOOKS = {
  queued: [t("waiting"), "wait"],
  running: [t("working"), "busy"],
  succeeded: [t("done"), "good"],
  failed: [t("failed"), "bad"],
  cancelled: [t("cancelled"), "off"],
};
const SHAPES = {
  wait: () => [svg("circle", { cx: 8, cy: 8, r: 5.5, fill: "none", "stroke-dasharray": "2.2 2.2" })],
  busy: () => [
    svg("circle", { cx: 8, cy: 8, r: 5.5, fill: "none", opacity: 0.35 }),
    svg("path", { d: "M8 2.5a5.5 5.5 0 0 1 5.5 5.5", fill: "none" }),
  ],
  good: () => [svg("path", { d: "M2.5 8.5l3.5 4 7.5-9", fill: "none" })],
  bad: () => [svg("path", { d: "M3.5 3.5l9 9m0-9l-9 9", fill: "none" })],
  warn: () => [svg("path", { d: "M8 2l6.5 11.5h-13zM8 6.5v3.2m0 1.6v.6", fill: "none" })],
  off: () => [svg("path", { d: "M3 8h10", fill: "none" })],
};

/** A shape of 16 x 16 in the colour of the text: kind "wait", "busy", "good", "bad", "warn" or "off". */
export function shape(kind) {
  const drawn = SHAPES[kind]?.() ?? SHAPES.off();
  return svg("svg", { class: `shape ${kind}`, viewBox: "0 0 16 16", "aria-hidden": "true" }, drawn);
}

/** Whether a job waits or is being made. */
export function isGoing({ state }) {
  return state === "queued" || state === "running";
}

/** Whether a mill may get a job's programs. job: a whole one, which offers them once they are checked, before their light is drawn. */
export function mayBeMilled({ state, programs, cancel_requested: givenUp }) {
  return programs.length > 0 && (state === "succeeded" || (state === "running" && !givenUp));
}

/** Whether a run is a dry pass: its program at a raised height, with the spindle off. */
export function isDry({ lift_mm: lift }) {
  return Number.isFinite(lift);
}

/** Whether a mill has cut the program of this run to its end. A dry pass cuts nothing. */
export function isCut(run) {
  return run.state === "finished" && !isDry(run);
}

/** The mark of a job's state; `words` in place of the usual word. */
export function stateMark(state, words) {
  const [word, kind] = LOOKS[state] ?? [state, "off"];
  return mark(kind, words ?? word);
}

/** Any mark: shape and words. */
export function mark(kind, words) {
  return h("span", { class: `mark ${kind}` }, shape(kind), words);
}
