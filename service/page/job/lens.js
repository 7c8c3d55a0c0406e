/** The lens as a surface: a body that turns, and a map of heights to read off. */
import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { mm } from "../lib/words.js";
import { surfaceOf } from "./drawing_file.js";
import { heightPicture } from "./height_map.js";
import { lensPicture } from "./lens_gl.js";
import { lensStage } from "./lens_stage.js";
import { extremes, heightAt, heightColour } from "./surface.js";
import { whenSeen } from "./when_seen.js";

/** {node, update(artifacts), free()} */
export function lensPart() {
  const map = h("canvas", { class: "height-map", role: "img" });
  const reading = h("p", { class: "height-reading" }, "Point at the map to read its height.");
  const scale = h("div", { class: "height-scale" });
  const caption = h("figcaption", {}, "Heights, as it lies on the mill");
  const mapBox = h("figure", { class: "lens-half" }, caption, map, scale, reading);
  const bodyBox = h("figure", { class: "lens-half" });
  const box = h("div", { class: "lens-halves" }, bodyBox, mapBox);
  const title = h("h2", { id: "lens-title" }, "Lens");
  const node = h("section", { class: "card", "aria-labelledby": "lens-title", hidden: true }, title, box);
  let wanted = null, known = "", grid = null, stage = null;
  const stop = whenSeen(node, load, (seen) => stage?.seen(seen));

  async function load() {
    if (!wanted || wanted.sha256 === known) return;
    const file = wanted;
    known = file.sha256;
    try {
      grid = surfaceOf(await api.bytes(file.url));
    } catch (error) {
      known = "";
      write(reading, error.detail ?? "The surface could not be read.");
      return;
    }
    drawMap();
    stage?.free();
    stage = lensStage(grid, lensPicture);
    bodyBox.hidden = !stage;
    if (stage) bodyBox.replaceChildren(h("figcaption", {}, "The lens: drag to turn it"), stage.node);
    stage?.seen(stop.seen());
  }
  function drawMap() {
    const { low, high } = extremes(grid);
    map.width = grid.nx;
    map.height = grid.ny;
    map.getContext("2d").putImageData(heightPicture(grid), 0, 0);
    map.setAttribute("aria-label", `Map of heights, from ${mm(-high)} to ${mm(-low)} under the top of the block`);
    const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => `rgb(${heightColour(share).join(" ")})`);
    const bar = h("span", { class: "height-bar", style: { "background-image": `linear-gradient(90deg, ${stops.join()})` } });
    scale.replaceChildren(h("span", {}, `${mm(-low)} deep`), bar, h("span", {}, mm(-high)));
  }
  map.addEventListener("pointermove", (event) => {
    if (!grid) return;
    const box = map.getBoundingClientRect();
    const x = grid.x0 + ((event.clientX - box.left) / box.width) * (grid.nx - 1) * grid.dx;
    const y = grid.y0 + (1 - (event.clientY - box.top) / box.height) * (grid.ny - 1) * grid.dy;
    const z = heightAt(grid, x, y);
    if (z !== null) write(reading, `X ${x.toFixed(2)}  Y ${y.toFixed(2)}  Z ${z.toFixed(3)} mm`);
  });
  function update(artifacts) {
    wanted = artifacts.get("surface.bin") ?? null;
    node.hidden = !wanted;
    stop.again();
  }
  return {
    node, update,
    free() {
      stop.end();
      stage?.free();
    },
  };
}
