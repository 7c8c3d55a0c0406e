/** The lens on a turntable, alone or with the wall that it lights: turns by itself until somebody drags it, but never if the browser asks for reduced motion. */
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { gestures } from "./gestures.js";

const START = { yaw: -0.6, pitch: 0.62, distance: 2.15 };
const WITH_WALL = { yaw: -0.7, pitch: 0.3, distance: 2.2 };
const TURN_PER_S = 0.25;
const PER_PIXEL = 0.008;
const FRAME_MS = 33;
const SLOW_MS = 120;
const SLOW_FRAMES = 12; // slow pictures in a row after which the lens stops turning, in a browser without graphics hardware

/** {node, seen(on), showWall(image, place), free()}, drawn by `make(canvas, grid)`; null if that gives nothing. */
export function lensStage(grid, make) {
  const label = t("The lens in three dimensions. Arrow keys turn it, plus and minus zoom.");
  const canvas = h("canvas", { class: "lens-canvas", tabindex: 0, role: "img", "aria-label": label });
  let picture = make(canvas, grid);
  if (!picture) return null;
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  const look = { ...START, wall: false };
  let turns = !still.matches, hung = null, seen = false, frame = 0, last = 0, slow = 0, freed = false;

  const spin = h("button", { type: "button", onclick: () => setTurning(!turns) });
  const front = () => (Object.assign(look, startOf()), ask());
  const wall = h("button", { type: "button", hidden: true, onclick: () => setWall(!look.wall) }, t("With the wall"));
  const reset = h("button", { type: "button", onclick: front }, t("Front"));
  const node = h("div", { class: "lens-stage" }, canvas, h("div", { class: "row lens-tools" }, wall, spin, reset));

  function setTurning(on) {
    turns = on;
    spin.textContent = on ? t("Stop turning") : t("Turn");
    ask();
  }
  /** The first viewpoint: for a wall, the side from which its picture is seen. */
  function startOf() {
    if (!look.wall) return START;
    return hung.place.viewedFrom === "lens" ? WITH_WALL : { ...WITH_WALL, yaw: Math.PI - WITH_WALL.yaw };
  }
  function setWall(on) {
    look.wall = on;
    wall.setAttribute("aria-pressed", String(on));
    front();
  }
  function ask() {
    if (!frame && seen && !freed) frame = requestAnimationFrame(draw);
  }
  function draw(time) {
    frame = 0;
    if (turns && time - last < FRAME_MS - 4) return ask();
    if (turns) look.yaw += TURN_PER_S * (Math.min(100, time - last) / 1000);
    slow = turns && time - last > SLOW_MS ? slow + 1 : 0;
    last = time;
    if (slow > SLOW_FRAMES) setTurning(false);
    const ratio = Math.min(2, devicePixelRatio || 1);
    const wide = Math.round(canvas.clientWidth * ratio), high = Math.round(canvas.clientHeight * ratio);
    if (wide && high) {
      if (canvas.width !== wide || canvas.height !== high) Object.assign(canvas, { width: wide, height: high });
      picture.draw(look);
    }
    if (turns) ask();
  }
  gestures(canvas, {
    start: () => setTurning(false),
    drag(dx, dy) {
      look.yaw -= dx * PER_PIXEL;
      look.pitch = Math.min(1.55, Math.max(-0.2, look.pitch + dy * PER_PIXEL));
      if (turns) setTurning(false);
      ask();
    },
    zoom(factor) {
      look.distance = Math.min(5, Math.max(0.7, look.distance / factor));
      ask();
    },
    reset: front,
  });
  const onStill = () => still.matches && setTurning(false);
  still.addEventListener("change", onStill);
  const watch = new ResizeObserver(ask);
  watch.observe(canvas);
  canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
  canvas.addEventListener("webglcontextrestored", () => {
    picture = make(canvas, grid);
    if (hung) picture.showWall(hung.image, hung.place);
    ask();
  });
  setTurning(turns);

  return {
    node,
    seen(on) {
      seen = on;
      ask();
    },
    showWall(image, place) {
      const first = !hung;
      hung = { image, place };
      picture.showWall(image, place);
      wall.hidden = false;
      if (first) setWall(true);
      ask();
    },
    free() {
      freed = true;
      cancelAnimationFrame(frame);
      still.removeEventListener("change", onStill);
      watch.disconnect();
      picture.free();
    },
  };
}
