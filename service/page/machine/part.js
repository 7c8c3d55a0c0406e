/**
 * The part seen from above: block, the path of the pass, the lens as far as it is cut, and the tool where it is now. A
 * pass that leaves stock shows its lines alone.
 */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isDry } from "../lib/state.js";
import { surfaceOf } from "../job/drawing_file.js";
import { passesOf } from "../job/figures.js";
import { heightPicture } from "../job/surface.js";
import { openPath } from "../job/path_file.js";
import { PathSketch } from "./path_sketch.js";
import { coordinate } from "./words.js";

const ROUND = new Set(["ellipse", "circle", "disc"]);
const EDGE = 0.06; // of the block, around it
const [LEAST_PX, MOST_PX] = [320, 420]; // high
const AROUND_PX = 570; // of the page's height: bars, head and words of the card, so that all of the part is in sight

export function part(link) {
  const canvas = h("canvas", { role: "img", "aria-label": t("The part from above") });
  const where = h("p", { class: "dim" });
  const node = h("section", { class: "card part", "aria-labelledby": "part-title" }, h("h2", { id: "part-title" }, t("On the part")), canvas, where);
  const sketch = new PathSketch();
  let scene = null;
  let shown = "";
  const watch = new ResizeObserver(() => draw());
  watch.observe(canvas);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  dark.addEventListener("change", draw);

  async function prepare(run) {
    shown = run.id;
    scene = null;
    sketch.clear();
    const job = await api.get(`/v1/jobs/${run.job}`).catch(() => null);
    if (shown !== run.id || !job?.spec) return;
    scene = sceneOf(job.spec, run);
    draw();
    const { artifacts } = await api.get(`/v1/jobs/${run.job}/artifacts`).catch(() => ({ artifacts: [] }));
    const path = await pathOf(run, artifacts).catch(() => null); // without it there is still the tool on the block
    const lens = path && !isDry(run) && (await lensOf(job, run, artifacts).catch(() => null));
    if (path && shown === run.id) sketch.take(path, run.program.name, lens);
    draw();
  }

  function draw() {
    if (!scene || node.hidden) return;
    const scale = fitScale(canvas, scene);
    if (!scale) return;
    const { run, machine } = link;
    sketch.draw(canvas, scale, scene, findCut(run));
    drawTool(canvas, scale, scene, machine?.mill);
  }

  return {
    node,
    update() {
      const { run, machine } = link;
      node.hidden = !run?.job || !run.open;
      if (node.hidden) return;
      if (run.id !== shown) prepare(run);
      const [x, y, z] = machine?.mill?.work_mm ?? [];
      const at = Number.isFinite(x) ? t`Tool at X ${coordinate(x, 2)}, Y ${coordinate(y, 2)}, Z ${coordinate(z, 2)} mm` : t("The position of the tool is unknown.");
      write(where, isDry(run) ? t`${at}; nothing is cut` : at);
      draw();
    },
    close() {
      watch.disconnect();
      dark.removeEventListener("change", draw);
    },
  };
}

/** What of its program a run has cut, for `PathSketch.draw`. */
export function findCut(run) {
  return run && !isDry(run) ? { line: run.executed_line, whole: run.state === "finished" } : { line: 0, whole: false };
}

/** The path of the run's pass, if its job has one. */
async function pathOf(run, artifacts) {
  const name = `${/pass-\d+/.exec(run.program.name)?.[0]}.path`;
  const file = artifacts.find((one) => one.name === name);
  return file ? openPath((from, to) => api.bytes(file.url, { from, to: Math.min(to, file.bytes) })) : null;
}

/** The lens for `PathSketch.take`; null if the run's pass does not make it. */
async function lensOf(job, run, artifacts) {
  const number = Number(/pass-(\d+)/.exec(run.program.name)?.[1]), file = artifacts.find((one) => one.name === "surface.bin");
  if (!file || passesOf(job)[number - 1]?.stock_to_leave_mm !== 0) return null;
  const { nx, ny, x0, y0, dx, dy, ...rest } = surfaceOf(await api.bytes(file.url));
  const picture = new OffscreenCanvas(nx, ny);
  picture.getContext("2d").putImageData(heightPicture({ nx, ny, ...rest }), 0, 0);
  return { picture, x0, y0, dx, dy };
}

/** Lens and block in work coordinates, mm. */
function sceneOf({ optics, stock }, run) {
  const margin = stock.margin_mm;
  return {
    lens: { x0: 0, y0: 0, x1: optics.width_mm, y1: optics.height_mm, round: ROUND.has(optics.outline) },
    block: { x0: -margin, y0: -margin, x1: optics.width_mm + margin, y1: optics.height_mm + margin },
    radius: run.setup?.tool?.radius_mm ?? 1,
  };
}

/** Sizes the canvas for the screen; how mm become pixels: {k, x(mm), y(mm)}. null if nothing can be seen. */
function fitScale(canvas, { block }) {
  const width = canvas.clientWidth;
  const [w, t] = [block.x1 - block.x0, block.y1 - block.y0];
  const room = Math.max(LEAST_PX, innerHeight - AROUND_PX);
  const height = Math.min(MOST_PX, room, (width * t) / w);
  if (!(width > 0 && height > 0)) return null;
  const dense = devicePixelRatio || 1;
  canvas.style.height = `${height}px`;
  const [own, tall] = [Math.round(width * dense), Math.round(height * dense)];
  if (canvas.width !== own || canvas.height !== tall) Object.assign(canvas, { width: own, height: tall });
  const k = Math.min(own / w, tall / t) * (1 - 2 * EDGE);
  const [left, low] = [(own - k * w) / 2 - k * block.x0, (tall + k * t) / 2 + k * block.y0];
  return { k, dense, x: (mm) => left + k * mm, y: (mm) => low - k * mm };
}

/** A ring as wide as the tool with a cross in it, red only if its place is not certain; at the rim of the picture if the tool is beside the part. */
function drawTool(canvas, { k, dense, x, y }, { radius }, mill) {
  const [px, py] = mill?.work_mm ?? [];
  if (!Number.isFinite(px)) return;
  const ink = canvas.getContext("2d");
  const r = Math.max(7 * dense, k * radius);
  const at = [Math.min(canvas.width - 4 * dense, Math.max(4 * dense, x(px))), Math.min(canvas.height - 4 * dense, Math.max(4 * dense, y(py)))];
  ink.beginPath();
  ink.arc(...at, r, 0, 2 * Math.PI);
  ink.moveTo(at[0] - 1.5 * r, at[1]);
  ink.lineTo(at[0] + 1.5 * r, at[1]);
  ink.moveTo(at[0], at[1] - 1.5 * r);
  ink.lineTo(at[0], at[1] + 1.5 * r);
  const stroke = (name, width) => Object.assign(ink, { strokeStyle: colour(canvas, name), lineWidth: width * dense }).stroke();
  stroke("--paper", 6); // around it, on any background
  stroke(mill.position_trusted ? "--ink" : "--bad", 2.5);
}

function colour(element, name) {
  return getComputedStyle(element).getPropertyValue(name);
}
