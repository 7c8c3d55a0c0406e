/** The picture on the wall, according to a spec. */

import { usualOf } from "./fields.js";
import { valueAt } from "./spec.js";

/** The effective value of a key of a spec: the given one, or its default. */
export const valueOf = (spec, key) => valueAt(spec, key) ?? usualOf(key);

/** The values of a spec that decide the drawing: {aspect, fit, invert}. */
export function screenOf(spec) {
  return {
    aspect: aspectOf(spec),
    fit: valueOf(spec, "image.fit"),
    invert: valueOf(spec, "image.invert"),
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

/** Width over height; 1 while the figures are not valid. */
function aspectOf(spec) {
  const { screen_height_mm } = spec.optics ?? {};
  const [width_mm, height_mm] = lensOf(spec);
  const aspect = widthOf(spec) / (screen_height_mm ?? (widthOf(spec) * height_mm) / width_mm);
  return aspect > 0.02 && aspect < 50 ? aspect : 1;
}
