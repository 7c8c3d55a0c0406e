/** A first guess of a blur, at once: what an estimate that is known comes to after a change. The server's own follows. */

import { usualOf } from "./fields.js";
import { valueAt } from "./spec.js";

const RAD = Math.PI / 180;
const RMS = Math.SQRT2 / 4; // of a disc of diameter 1, over both axes

/**
 * The blur on the wall in mm: what the tool's marks and the light's own size make of a point grows with the distance;
 * how fine the passes would then be is not known here.
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
  const kind = valueAt(spec, "optics.light.kind") ?? usualOf("optics.light.kind");
  if (kind === "sun") return far * at("size_deg") * RAD;
  return kind === "point" ? (far * at("size_mm")) / at("distance_mm") : 0;
}

function numberAt(spec, key) {
  return Number(valueAt(spec, key) ?? usualOf(key));
}
