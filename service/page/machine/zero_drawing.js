/** Shows where X0 Y0 will be set: block and lens from above, of the job on the mill or of an example. */

import { h, replace, svg, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { figures, mm } from "../lib/words.js";

const ANY = { width_mm: 116, height_mm: 116, margin_mm: 16 }; // a margin that is visible at this size
const [WIDE, HIGH] = [132, 116];
const [TOP, FOOT, SIDE] = [16, 18, 6]; // room for the words above and below the block, and beside it
const AXIS = 20;

export function zeroDrawing(link) {
  const drawing = h("div", { class: "zero-drawing" });
  const corner = h("strong", {}, t("X0 Y0 is the front left corner of the lens, not of the block."));
  const inside = h("span", { class: "dim" });
  const words = h("p", {}, corner, " ", inside);
  const node = h("section", { class: "card zero-place", "aria-label": t("Where zero is") }, drawing, words);
  let shown = null;
  return {
    node,
    update() {
      const { run } = link;
      const stock = ((run?.open || run?.next) && run.setup?.stock) || null;
      const key = JSON.stringify(stock);
      if (key === shown) return;
      shown = key;
      const known = stock && t`${mm(stock.margin_mm)} inside the block's left and front edges.`;
      write(inside, t`${known ?? t("The distance inside the block is known once a program is loaded.")} Z0 is the block's top.`);
      replace(drawing, stock ? drawStock(stock, sizes(stock)) : drawStock(ANY, [t("block, not to scale"), t("inside the block, not to scale")], "guess"));
    },
  };
}

/** Texts of the block in the drawing, and of the corner for people who cannot see it. */
function sizes({ width_mm, height_mm, margin_mm }) {
  const block = t`block ${figures(width_mm, 3)} × ${figures(height_mm, 3)} mm`;
  return [block, t`${mm(margin_mm)} inside the ${block}`];
}

/** @param {any} stock @param {string[]} words */
function drawStock(stock, [block, where], kind = "") {
  const k = Math.min((WIDE - 2 * SIDE) / stock.width_mm, (HIGH - TOP - FOOT) / stock.height_mm);
  const [width, height, margin] = [stock.width_mm, stock.height_mm, stock.margin_mm].map((side) => k * side);
  const [left, low] = [(WIDE - width) / 2, HIGH - FOOT];
  const [x, y] = [left + margin, low - margin];
  const name = t`Seen from above: X0 Y0 is the front left corner of the lens, ${where}`;
  return svg(
    "svg",
    { role: "img", class: kind, "aria-label": name, viewBox: `0 0 ${WIDE} ${HIGH}`, width: WIDE, height: HIGH },
    svg("rect", { class: "block", x: left, y: low - height, width, height, rx: 2 }),
    svg("rect", { class: "lens", x, y: low - height + margin, width: width - 2 * margin, height: height - 2 * margin }),
    svg("text", { x: WIDE / 2, y: low - height - 5, "text-anchor": "middle" }, block),
    svg("text", { x: WIDE / 2, y: low - height / 2 + 4, "text-anchor": "middle" }, t("lens")),
    svg("path", { class: "axes", d: `M${x} ${y - AXIS}V${y}H${x + AXIS}` }),
    svg("circle", { class: "corner", cx: x, cy: y, r: 4 }),
    svg("text", { class: "origin", x: x - 4, y: HIGH - 4 }, "X0 Y0"),
  );
}
