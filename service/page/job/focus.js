/** The caustic on a wall nearer or farther than it should be: a slider through the pictures of focus.bin. */
import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { mm } from "../lib/words.js";
import { blurred, greyOf, toLinear } from "../new/tones.js";
import { focusOf } from "./drawing_file.js";
import { focusSentence } from "./figures.js";
import { whenSeen } from "./when_seen.js";

/** {node, update(artifacts, job), free()} */
export function focusPart() {
  const canvas = h("canvas", { class: "focus-picture", role: "img", "aria-label": "The caustic on the wall" });
  const words = h("p", { class: "focus-words", "aria-live": "polite" });
  const sentence = h("p", { class: "dim" });
  const range = h("input", { type: "range", step: 1, min: 0, "aria-label": "Distance of the wall", oninput: () => draw() });
  const ends = h("div", { class: "range-ends dim" }, h("span", {}, "nearer"), h("span", {}, "farther"));
  const back = h("button", { type: "button", onclick: () => aim() }, "Back to focus");
  const node = h(
    "section", { class: "card", "aria-labelledby": "focus-title", hidden: true },
    h("h2", { id: "focus-title" }, "Distance of the wall"), canvas, range, ends,
    h("div", { class: "row spread" }, words, back), sentence,
  );
  let frames = null, known = "", blurShare = 0;
  const stop = whenSeen(node, load);
  let wanted = null;

  async function load() {
    if (!wanted || wanted.sha256 === known) return;
    const file = wanted;
    known = file.sha256;
    try {
      frames = focusOf(await api.bytes(file.url));
    } catch (error) {
      known = "";
      write(words, error.detail ?? "This picture could not be read.");
      return;
    }
    canvas.width = frames.nx;
    canvas.height = frames.ny;
    range.max = frames.factors.length - 1;
    aim();
  }
  function aim() {
    if (!frames) return;
    const off = frames.factors.map((factor) => Math.abs(factor - 1));
    range.value = off.indexOf(Math.min(...off));
    draw();
  }
  function draw() {
    if (!frames) return;
    const k = Number(range.value), factor = frames.factors[k];
    const picture = new ImageData(frames.nx, frames.ny), sigma = factor * blurShare * frames.nx;
    const light = Float32Array.from(frames.frame(k), (level) => toLinear(level / 255));
    picture.data.set(greyOf(sigma > 0 ? blurred(light, frames.nx, frames.ny, sigma) : light));
    canvas.getContext("2d").putImageData(picture, 0, 0);
    const text = `${distanceWords(factor, frames.throwMm)}; ${blurShare ? "about as milled" : "as designed"}`;
    write(words, text);
    range.setAttribute("aria-valuetext", text);
    back.disabled = factor === 1;
  }
  /** The pictures are of the lens as designed; what is left on it blurs them in proportion to the distance. */
  function update(artifacts, { report, spec }) {
    const share = (report?.as_finished ?? report?.as_milled)?.blur_px / Math.SQRT2 / spec.image.pixels || 0; // over both axes
    if (share !== blurShare) {
      blurShare = share;
      draw();
    }
    wanted = artifacts.get("focus.bin") ?? null;
    node.hidden = !wanted;
    write(sentence, focusSentence(report) ?? "");
    stop.again();
  }
  return { node, update, free: stop.end };
}

/** "Wall at 48 mm, 12 mm too near". */
export function distanceWords(factor, throwMm) {
  const at = `Wall at ${mm(factor * throwMm)}`, off = (factor - 1) * throwMm;
  if (Math.abs(off) < 1e-9 * throwMm) return `${at}: in focus`;
  return `${at}: ${mm(Math.abs(off))} too ${off < 0 ? "near" : "far"}`;
}
