/** The picture on the wall, as a spec says it. */

import { valueAt } from "./spec.js";

/** All of a spec that decides what is drawn: {aspect, fit, tone, invert, width_mm}. */
export function screenOf(spec) {
  return {
    aspect: aspectOf(spec),
    fit: valueAt(spec, "image.fit") ?? "crop",
    tone: valueAt(spec, "image.tone") ?? "srgb",
    invert: valueAt(spec, "image.invert") ?? false,
    width_mm: widthOf(spec),
  };
}

function widthOf(spec) {
  const { width_mm = 100, height_mm = 100, screen_width_mm, screen_height_mm } = spec.optics ?? {};
  return screen_width_mm ?? (screen_height_mm === undefined ? width_mm : (screen_height_mm * width_mm) / height_mm);
}

/** Width over height; 1 while the figures make no sense. */
function aspectOf(spec) {
  const { width_mm = 100, height_mm = 100, screen_height_mm } = spec.optics ?? {};
  const aspect = widthOf(spec) / (screen_height_mm ?? (widthOf(spec) * height_mm) / width_mm);
  return aspect > 0.02 && aspect < 50 ? aspect : 1;
}
