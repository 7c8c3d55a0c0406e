/** What lies over a drawn path and keeps its own size: the lens's outline, the tool, a scale. */
import { svg } from "../lib/dom.js";

const ROUND = [1, 2, 5];

/** {node, place(camera, {width, height}, outline [[x, y]..] mm, tool {x, y} | null, radius mm)} */
export function pathOverlay() {
  const lens = svg("polygon", { class: "path-lens" });
  const ball = svg("circle", { class: "path-tool" }), tip = svg("circle", { class: "path-tip", r: 3.5 });
  const bar = svg("path", { class: "path-scale" }), words = svg("text", { class: "path-scale-words" });
  const node = svg("svg", { class: "path-overlay", "aria-hidden": "true" }, lens, ball, tip, bar, words);

  function place(camera, { width, height }, outline, tool, radius) {
    const px = (x) => width / 2 + (x - camera.x) * camera.scale, py = (y) => height / 2 - (y - camera.y) * camera.scale;
    lens.setAttribute("points", (outline ?? []).map(([x, y]) => `${px(x).toFixed(1)},${py(y).toFixed(1)}`).join(" "));
    for (const mark of [ball, tip]) {
      mark.style.display = tool ? "" : "none";
      if (!tool) continue;
      mark.setAttribute("cx", px(tool.x).toFixed(1));
      mark.setAttribute("cy", py(tool.y).toFixed(1));
    }
    ball.setAttribute("r", Math.max(0, radius * camera.scale).toFixed(1));
    const length = roundLength(Math.min(120, width / 4) / camera.scale), reach = length * camera.scale;
    bar.setAttribute("d", `M12 ${height - 20}v6h${reach.toFixed(1)}v-6`);
    words.setAttribute("x", 12 + reach / 2);
    words.setAttribute("y", height - 20);
    words.textContent = length >= 0.1 ? `${+length.toFixed(1)} mm` : `${+(length * 1000).toPrecision(1)} µm`;
  }
  return { node, place };
}

/** The longest of 1, 2, 5, 10, .. that is not longer. */
export function roundLength(length) {
  const decade = 10 ** Math.floor(Math.log10(length));
  return decade * ROUND.findLast((each) => each * decade <= length * 1.0001);
}
