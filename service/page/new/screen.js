/** The picture on the wall, as a spec says it; and a first guess of its blur. */

import { usualOf } from "./fields.js";
import { valueAt } from "./spec.js";

const RAD = Math.PI / 180;
const RMS = Math.SQRT2 / 4; // of a disc of diameter 1, over both axes

/** What counts for a key of a spec, given or left out. */
export const valueOf = (spec, key) => valueAt(spec, key) ?? usualOf(key);

/** All of a spec that decides what is drawn: {aspect, fit, tone, invert, width_mm}. */
export function screenOf(spec) {
  return {
    aspect: aspectOf(spec),
    fit: valueOf(spec, "image.fit"),
    tone: valueOf(spec, "image.tone"),
    invert: valueOf(spec, "image.invert"),
    width_mm: widthOf(spec),
  };
}

function lensOf(spec) {
  return ["width", "height"].map((side) => valueOf(spec, `optics.${side}_mm`));
}

function widthOf(spec) {
  const { screen_width_mm, screen_height_mm } = spec.optics ?? {};
  const [width_mm, height_mm] = lensOf(spec);
  return screen_width_mm ?? (screen_height_mm === undefined ? width_mm : (screen_height_mm * width_mm) / height_mm);
}

/** Width over height; 1 while the figures make no sense. */
function aspectOf(spec) {
  const { screen_height_mm } = spec.optics ?? {};
  const [width_mm, height_mm] = lensOf(spec);
  const aspect = widthOf(spec) / (screen_height_mm ?? (widthOf(spec) * height_mm) / width_mm);
  return aspect > 0.02 && aspect < 50 ? aspect : 1;
}

/**
 * What an estimate that is known comes to after a change, before the server's own follows: the blur on the wall in mm.
 * What the tool's marks and the light's own size make of a point grows with the distance; how fine the passes would
 * then be is not known here.
 */
export function coarseBlur({ blur_by: known, blur_mm: whole, spec: then }, now) {
  const [far, farThen] = [now, then].map((spec) => numberAt(spec, "optics.throw_mm"));
  const [disc, discThen] = [now, then].map(lightMm);
  const light = known.light_mm > 0 && discThen > 0 ? (known.light_mm * disc) / discThen : disc * RMS;
  const blur = Math.hypot((known.milling_mm * far) / farThen, light);
  return Number.isFinite(blur) ? blur : whole;
}

/** How wide the light itself makes a point on the wall. */
function lightMm(spec) {
  const at = (key) => numberAt(spec, `optics.light.${key}`), far = numberAt(spec, "optics.throw_mm");
  const kind = valueOf(spec, "optics.light.kind");
  if (kind === "sun") return far * at("size_deg") * RAD;
  return kind === "point" ? (far * at("size_mm")) / at("distance_mm") : 0;
}

function numberAt(spec, key) {
  return Number(valueOf(spec, key));
}
