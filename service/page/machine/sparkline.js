/** A small plot of a figure over the last minute. */

import { h, svg } from "../lib/dom.js";
import { t } from "../lib/language.js";

const SPAN_MS = 60_000;
const [WIDE, HIGH] = [120, 28];

/** {node, add(value)}; most: the top of the plot, 0: the most that was seen. null ends it: it is not shown then. */
export function sparkline(name, most) {
  const line = svg("polyline", { points: "" });
  const drawn = svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", role: "img", "aria-label": t`${name} in the last minute` }, line);
  const node = h("dd", { class: "spark", hidden: true }, drawn);
  let points = []; // {at, value}
  return {
    node,
    add(value) {
      const at = performance.now();
      points = Number.isFinite(value) ? [...points.filter((one) => at - one.at < SPAN_MS), { at, value }] : [];
      node.hidden = points.length < 2;
      const top = most || Math.max(1, ...points.map((one) => one.value));
      const place = (one) => `${(WIDE * (1 - (at - one.at) / SPAN_MS)).toFixed(1)},${((HIGH - 2) * (1 - Math.min(1, one.value / top)) + 1).toFixed(1)}`;
      line.setAttribute("points", points.map(place).join(" "));
    },
  };
}
