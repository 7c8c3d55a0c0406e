/**
 * A view of a tool path: the drawing follows pointer and wheel at once, and is redrawn in finer detail when they rest.
 *
 * The canvas is larger than its frame. While it is moved or zoomed, only its transform changes, so that this costs the
 * same for ten moves as for ten million; if drawing is quick, it is also redrawn in every frame. Then the view chooses
 * the level of the file whose tolerance cannot be seen, fetches those of its chunks that meet the frame, and replaces
 * the drawing with them.
 */
import { h, svg } from "../lib/dom.js";
import { gestures } from "./gestures.js";
import { plainPathPicture } from "./path_2d.js";
import { chunksIn } from "./path_file.js";
import { pathPicture } from "./path_gl.js";

const OVERSIZE = 1.5;
const SEEN_PX = 1; // a tolerance of fewer device pixels cannot be seen
const REST_MS = 140;
const QUICK_MS = 9;
const PATIENT_MS = 90; // longest time for drawing one picture
const BUDGET = { first: 150_000, least: 60_000, most: 1_200_000 }; // points of one picture
const LEAST_TOLD = 20_000; // points whose picture tells how fast this browser draws
const HELD_BYTES = 48 << 20; // of each level
const MOST_SCALE = 2000; // px per mm

/** {node, show(file), time(t), rapids(on), fit(), zoom(factor), at(t), free()}; onDrawn({number, ms, points, sharp}).
 * @param {{label: string, outline: any, onDrawn?: (drawn: object) => void}} options */
export function pathView({ label, outline, onDrawn = () => {} }) {
  const canvas = h("canvas", { class: "path-canvas" });
  const overlay = pathOverlay();
  const node = h("div", { class: "path-frame", tabindex: 0, role: "img", "aria-label": label }, canvas, overlay.node);
  let picture = pathPicture(canvas) ?? plainPathPicture(canvas);
  let file = null, camera = { x: 0, y: 0, scale: 1 }, drawn = null, fetching = null, freed = false;
  let now = Infinity, rapids = true, budget = BUDGET.first, cost = 0;
  let rest = 0, frame = 0, busy = false, again = 0;

  const ratio = () => Math.min(2, devicePixelRatio || 1);
  const size = () => ({ width: node.clientWidth, height: node.clientHeight });

  function fit() {
    const { x, y } = file.head.cut_bounds_mm ?? file.head.bounds_mm, { width, height } = size();
    const wide = Math.max(x[1] - x[0], 1e-3), deep = Math.max(y[1] - y[0], 1e-3);
    camera = { x: (x[0] + x[1]) / 2, y: (y[0] + y[1]) / 2, scale: 0.92 * Math.min(width / wide, height / deep) };
    moved();
  }
  function zoom(factor, px = size().width / 2, py = size().height / 2) {
    const scale = Math.min(MOST_SCALE, Math.max(0.2, camera.scale * factor));
    const dx = px - size().width / 2, dy = size().height / 2 - py;
    camera.x += dx / camera.scale - dx / scale;
    camera.y += dy / camera.scale - dy / scale;
    camera.scale = scale;
    moved();
  }
  function drag(dx, dy) {
    camera.x -= dx / camera.scale;
    camera.y += dy / camera.scale;
    moved();
  }

  /** Show the present drawing at the camera's place, and redraw it as soon as that does not disturb. */
  function moved() {
    place();
    clearTimeout(rest);
    if (cost <= QUICK_MS || bare()) soon();
    rest = setTimeout(refine, REST_MS);
  }
  function place() {
    if (drawn) {
      const dx = (drawn.x - camera.x) * camera.scale, dy = (camera.y - drawn.y) * camera.scale;
      canvas.style.transform = `translate(-50%, -50%) translate(${dx}px, ${dy}px) scale(${camera.scale / drawn.scale})`;
    }
    overlay.place(camera, size(), outline, tool(), file?.head.radius_mm ?? 0);
  }
  /** Part of the frame shows nothing because the canvas was moved off it. */
  function bare() {
    if (!drawn) return true;
    const { width, height } = size(), scale = camera.scale / drawn.scale;
    const off = (shift, side) => Math.abs(shift) * camera.scale > (side * (OVERSIZE * scale - 1)) / 2 + 1;
    return scale > 0.99 && (off(drawn.x - camera.x, width) || off(drawn.y - camera.y, height));
  }
  function soon() {
    frame ||= requestAnimationFrame(() => {
      frame = 0;
      draw(Math.min(budget, BUDGET.first));
    });
  }

  /** The rectangle in mm that the canvas shows. */
  function rectangle() {
    const { width, height } = size(), reach = OVERSIZE / 2 / camera.scale, x = width * reach, y = height * reach;
    return { x0: camera.x - x, x1: camera.x + x, y0: camera.y - y, y1: camera.y + y };
  }
  /** The finest level worth drawing that is completely loaded. */
  function ready(most) {
    const seen = rectangle();
    for (let number = file.levels.length - 1; number > 0; number--) {
      const { rows, data } = file.levels[number];
      if (!rows || tooFine(number)) continue;
      const { chunks, points } = chunksIn(rows, seen);
      if (points <= most && chunks.every((k) => data.has(k))) return { number, chunks };
    }
    return { number: 0, chunks: chunksIn(file.levels[0].rows, seen).chunks };
  }
  /** The level before it looks the same. */
  function tooFine(number) {
    return number > 0 && file.levels[number - 1].tolerance_mm * camera.scale * ratio() < SEEN_PX;
  }
  /** Draw one picture at a time; a request that arrives meanwhile is drawn after it. */
  async function draw(most = budget) {
    if (!file || freed || !size().width) return;
    if (busy) return void (again = Math.max(again, most));
    const { number, chunks } = ready(most), level = file.levels[number];
    const points = chunks.reduce((sum, k) => sum + level.rows[k].count, 0);
    busy = true;
    fitCanvas();
    const done = picture.draw({
      camera, ratio: ratio(), now, rapids, colours: coloursOf(node), depth: depthOf(file.head),
      chunks: chunks.map((k) => ({ row: level.rows[k], points: level.data.get(k) })),
    });
    drawn = { ...camera };
    place();
    cost = await done;
    busy = false;
    if (freed) return;
    const affordable = (points / Math.max(cost, 1)) * PATIENT_MS;
    if (points > LEAST_TOLD) budget = Math.min(BUDGET.most, Math.max(BUDGET.least, affordable));
    onDrawn({ number, ms: cost, points, sharp: tooFine(number + 1) });
    const next = again;
    again = 0;
    if (next) draw(next);
  }
  function worth(number) {
    return number < file.levels.length && !tooFine(number);
  }
  function fitCanvas() {
    const { width, height } = size();
    const wide = Math.round(width * OVERSIZE * ratio()), high = Math.round(height * OVERSIZE * ratio());
    if (canvas.width === wide && canvas.height === high) return;
    canvas.width = wide;
    canvas.height = high;
    canvas.style.width = `${width * OVERSIZE}px`;
    canvas.style.height = `${height * OVERSIZE}px`;
  }

  /** Fetch the detail that an eye could see, and draw it. */
  async function refine() {
    if (!file || freed) return;
    fetching?.abort();
    const mine = (fetching = new AbortController());
    try {
      const seen = rectangle();
      let best = 0, chunks = [];
      for (let number = 1; worth(number); number++) {
        const found = chunksIn(await file.rows(number, mine.signal), seen);
        if (found.points > budget) break;
        best = number;
        chunks = found.chunks;
      }
      await file.load(best, chunks, mine.signal);
    } catch (error) {
      if (mine.signal.aborted) return;
      console.warn(`tool path: ${error.message}`);
    }
    if (mine.signal.aborted || freed) return;
    file.forget(HELD_BYTES);
    draw();
  }
  const tool = () => (file && Number.isFinite(now) ? file.at(now) : null);

  gestures(node, { drag, zoom, reset: () => fit() });
  const watch = new ResizeObserver(() => file && moved());
  watch.observe(node);
  const scheme = matchMedia("(prefers-color-scheme: dark)");
  const redraw = () => soon();
  scheme.addEventListener("change", redraw);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    picture = pathPicture(canvas);
    soon();
  });

  return {
    node, fit, zoom,
    show(next) {
      file = next;
      drawn = null;
      fit();
    },
    time(t) {
      now = t;
      place();
      soon();
      clearTimeout(rest);
      rest = setTimeout(refine, REST_MS);
      return tool();
    },
    rapids(on) {
      rapids = on;
      soon();
    },
    free() {
      freed = true;
      fetching?.abort();
      clearTimeout(rest);
      cancelAnimationFrame(frame);
      watch.disconnect();
      scheme.removeEventListener("change", redraw);
      picture.free();
    },
  };
}

function depthOf(head) {
  return (head.cut_bounds_mm ?? head.bounds_mm).z;
}

/** Colours of the drawing as shares of 1, from the page's style. */
function coloursOf(node) {
  const style = getComputedStyle(node);
  const share = (name) => style.getPropertyValue(`--path-${name}`).match(/[\d.]+/g).slice(0, 3).map((part) => Number(part) / 255);
  return { deep: share("deep"), high: share("high"), coming: share("coming"), rapid: share("rapid") };
}

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
