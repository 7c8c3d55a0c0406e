/** Touching off with a plate: Z alone, or a block's corner from above, from the left and from the front. */

import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { guardedButton } from "./order_controls.js";

const KEPT = "causticmill-corner-plate";
const ASIDE_MM = 20;
const BELOW_MM = 1; // and the cutter's radius: a ball touches with its side only above that

/** Touch off Z: go down to the plate, whose thickness is then the height. */
export function probePart(order) {
  const plate = number(0, { min: -100, max: 100, step: "any" });
  const depth = number(10, { min: 0.1, max: 200, step: "any" });
  const feed = number(50, { min: 1, max: 1000, step: 1 });
  const start = () => order("probe", { plate_mm: plate.valueAsNumber, depth_mm: depth.valueAsNumber, feed_mm_per_min: feed.valueAsNumber, retract_mm: 2 });
  const ask = guardedButton(t("Probe Z"), {
    words: () => t`The tool goes down by up to ${depth.value} mm until it touches. Is the plate under it, and the clip on the tool?`,
    yes: t("Probe"),
    act: start,
  });
  return part(t("Probe Z with a plate"), ask, [field(t("Plate thickness"), plate, "mm"), field(t("Down at most"), depth, "mm"), field(t("Feed"), feed, "mm/min")]);
}

/** The measures of a corner plate are kept; cutter and block come from the loaded program, unless a person changes them. */
export function cornerPart(order, changed) {
  const { plate = "", left = "", front = "" } = JSON.parse(localStorage.getItem(KEPT) ?? "{}");
  const any = { min: 0, max: 100, step: "any" };
  const given = { plate: number(plate, any), left: number(left, any), front: number(front, any), depth: number(10, { ...any, max: 200 }), radius: number("", { ...any, min: 0.01, max: 50 }), margin: number("", { ...any, max: 1000 }) };
  const inputs = Object.values(given);
  for (const input of inputs) Object.assign(input, { required: true, oninput: () => ((input.dataset.said = "yes"), changed()) });
  const start = () => {
    const mm = Object.fromEntries(Object.entries(given).map(([key, input]) => [key, input.valueAsNumber]));
    localStorage.setItem(KEPT, JSON.stringify({ plate: mm.plate, left: mm.left, front: mm.front }));
    order("probe-corner", { plate_mm: mm.plate, wall_x_mm: mm.left, wall_y_mm: mm.front, depth_mm: mm.depth, cutter_radius_mm: mm.radius, margin_mm: mm.margin, aside_mm: ASIDE_MM + mm.radius, below_mm: BELOW_MM + mm.radius });
  };
  const ask = guardedButton(t("Probe the corner"), {
    words: () => t`The tool touches the plate under it, then goes ${ASIDE_MM} mm and its radius to the left, later to the front, down there and back until it touches. Does it stand over the plate, nearer than ${ASIDE_MM} mm to both faces, with the spindle off, the clip on it and nothing beside the block?`,
    yes: t("Probe"),
    act: start,
  });
  const fields = [
    field(t("Plate on the block"), given.plate, "mm"),
    field(t("Plate left of the block"), given.left, "mm"),
    field(t("Plate in front of the block"), given.front, "mm"),
    field(t("Down to the plate, at most"), given.depth, "mm"),
    field(t("Cutter radius"), given.radius, "mm"),
    field(t("X0 Y0 inside the edges"), given.margin, "mm"),
  ];
  const whole = part(t("Probe the corner with a plate"), ask, fields);
  return {
    ...whole,
    get isWhole() {
      return inputs.every((input) => input.checkValidity());
    },
    update(setup) {
      suggest(given.radius, setup?.tool?.radius_mm);
      suggest(given.margin, setup?.stock?.margin_mm);
    },
  };
}

function suggest(input, value) {
  if (value !== undefined && value !== null && !input.dataset.said && input.value !== String(value)) input.value = value;
}

function part(title, ask, fields) {
  const node = h("details", { class: "probe" }, h("summary", {}, title), h("div", { class: "probe-form" }, fields, ask.node));
  return { node, button: ask.button, close: ask.close };
}

export function number(value, { min, max, step }) {
  return h("input", { type: "number", min, max, step, value, inputMode: "decimal" });
}

export function field(label, input, unit) {
  return h("label", { class: "field" }, h("span", {}, label), unit ? h("span", { class: "with-unit" }, input, h("span", {}, unit)) : input);
}
