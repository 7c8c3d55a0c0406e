/** The lens as a surface: a body that turns, and a map of heights to read off. */
import { api } from "../lib/api.js";
import { h, whenSeen, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mm } from "../lib/words.js";
import { surfaceOf } from "./drawing_file.js";
import { screenOf } from "./figures.js";
import { fold } from "./fold.js";
import { lensPicture } from "./lens_gl.js";
import { lensStage } from "./lens_stage.js";
import { extremes, heightAt, heightColour, heightPicture } from "./surface.js";

const WALLS = ["caustic-as-finished.png", "caustic-as-milled.png", "caustic.png"]; // the picture on the wall, as far as it is known

/** {node, update(artifacts, spec), free()} */
export function lensPart() {
  const map = h("canvas", { class: "height-map", role: "img", "aria-label": t("Heights, as it lies on the mill") });
  const reading = h("p", { class: "height-reading" }, t("Point at the map to read its height."));
  const scale = h("div", { class: "height-scale" });
  const caption = h("figcaption", {}, t("Heights, as it lies on the mill"));
  const mapBox = h("figure", { class: "lens-half" }, caption, map, scale, reading);
  const bodyBox = h("figure", { class: "lens-half" });
  const box = h("div", { class: "lens-halves" }, bodyBox, mapBox);
  const node = fold("lens", t("Lens"), box);
  let wanted = null, known = "", grid = null, stage = null, spec = null, picture = null, hung = "";
  const stop = whenSeen(box, load, (seen) => stage?.seen(seen));

  async function load() {
    await loadSurface();
    await loadWall();
  }
  async function loadWall() {
    if (!stage || !picture || picture.sha256 === hung) return;
    const { sha256, url } = picture;
    hung = sha256;
    const { screen_shift_x_mm: x, screen_shift_y_mm: y, throw_mm, viewed_from: viewedFrom } = spec.optics;
    try {
      const image = await createImageBitmap(new Blob([await api.bytes(url)]));
      if (hung === sha256) stage?.showWall(image, { screen: screenOf(spec), shift: [x ?? 0, y ?? 0], throw_mm, viewedFrom });
    } catch {
      hung = ""; // the lens stands alone
    }
  }
  async function loadSurface() {
    if (!wanted || wanted.sha256 === known) return;
    const file = wanted;
    known = file.sha256;
    try {
      grid = surfaceOf(await api.bytes(file.url));
    } catch (error) {
      known = "";
      write(reading, error.detail ?? t("The surface could not be read."));
      return;
    }
    drawMap();
    stage?.free();
    stage = lensStage(grid, lensPicture);
    hung = "";
    bodyBox.hidden = !stage;
    if (stage) bodyBox.replaceChildren(h("figcaption", {}, t("The lens and its light: drag to turn it")), stage.node);
    stage?.seen(stop.seen());
  }
  function drawMap() {
    const { low, high } = extremes(grid);
    map.width = grid.nx;
    map.height = grid.ny;
    map.getContext("2d").putImageData(heightPicture(grid), 0, 0);
    map.setAttribute("aria-label", t`Map of heights, from ${mm(-high)} to ${mm(-low)} under the top of the block`);
    const stops = [0, 0.25, 0.5, 0.75, 1].map((share) => `rgb(${heightColour(share).join(" ")})`);
    const bar = h("span", { class: "height-bar", style: { "background-image": `linear-gradient(90deg, ${stops.join()})` } });
    scale.replaceChildren(h("span", {}, t`${mm(-low)} deep`), bar, h("span", {}, mm(-high)));
  }
  map.addEventListener("pointermove", (event) => {
    if (!grid) return;
    const box = map.getBoundingClientRect();
    const x = grid.x0 + ((event.clientX - box.left) / box.width) * (grid.nx - 1) * grid.dx;
    const y = grid.y0 + (1 - (event.clientY - box.top) / box.height) * (grid.ny - 1) * grid.dy;
    const z = heightAt(grid, x, y);
    if (z !== null) write(reading, `X ${x.toFixed(2)}  Y ${y.toFixed(2)}  Z ${z.toFixed(3)} mm`);
  });
  function update(artifacts, own) {
    wanted = artifacts.get("surface.bin") ?? null;
    picture = WALLS.map((name) => artifacts.get(name)).find(Boolean) ?? null;
    spec = own;
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
