/** Live light: computes the wall's picture again while somebody moves wall, block and lamp. */
import { api } from "../lib/api.js";
import { freshId, h, replace, whenSeen, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mm } from "../lib/words.js";
import { lightOf } from "./drawing_file.js";
import { focusSentence, isSharpened } from "./figures.js";
import { fold } from "./fold.js";
import { gestures } from "./gestures.js";
import { beamCount, beamsOf, lightPicture, settingOf } from "./light_gl.js";

const DESIGNED = "light.bin";
const SURFACES = [
  [DESIGNED, t("As designed"), t("A perfect surface.")],
  ["light-as-milled.bin", t("As milled"), t("With the tool's marks, the same everywhere; single grooves are not drawn.")],
  ["light-as-finished.bin", t("As finished"), t("After the work by hand.")],
];
const SHARPENED = t("Drawn sharper than the picture, for the tool to blur: without the tool's marks it looks broken.");
const PIXELS = [512, 1024];
const MANY_BEAMS = 32; // from which their blur hides a coarser net
const FEW_BEAMS = 12; // with fewer, the first picture of a surface with marks is sharp, which the wall never is
const FIRST_CELLS = 2 ** 16, MOST_CELLS = 2 ** 25; // drawn in a frame
const QUICK_MS = 24, SLOW_MS = 50;
const RAD = Math.PI / 180;

/** {node, update(artifacts, job), free()} */
export function lightPart() {
  const canvas = h("canvas", { class: "light-canvas", tabindex: 0, role: "img", "aria-label": t("The picture on the wall. Up and down move the wall, left and right turn the block, Home sets all back.") });
  const still = h("p", { class: "dim", hidden: true }, t("This browser has no WebGL2 for live light; the pictures above show the wall as it should stand."));
  const words = h("p", { class: "light-words", "aria-live": "polite" }), note = h("p", { class: "dim" });
  const which = h("select", { "aria-label": t("Surface"), onchange: () => ((chosen = true), load()) });
  const fine = h("select", { "aria-label": t("Pixels of the picture"), onchange: () => begin() }, PIXELS.map((count) => h("option", { value: count }, t`${count} pixels`)));
  const rows = h("div", { class: "light-rows" });
  const tools = h("div", { class: "row" }, which, fine, h("button", { type: "button", onclick: () => reset() }, t("Reset all")));
  const live = h("div", { class: "light-live" }, canvas, h("div", { class: "stack" }, tools, words, rows, note));
  const node = fold("light", t("Light"), still, live);
  let files = new Map(), job = null, chosen = false, known = "", lens = null, picture = null, setting = null, sliders = [];
  let frame = 0, last = 0, cells = FIRST_CELLS, moved = false, pending = null, gone = false;
  const seen = whenSeen(live, load, () => ask());

  async function load() {
    const file = files.get(which.value);
    if (!file || file.sha256 === known) return;
    known = file.sha256;
    try {
      const found = await lightOf(await api.bytes(file.url));
      if (gone || known !== file.sha256) return;
      lens = { ...found, thickness_mm: job.spec.stock.thickness_mm || found.thickness_mm };
    } catch (error) {
      known = "";
      write(words, error.detail ?? t("The light could not be read."));
      return;
    }
    write(note, noteWords());
    if (!setting) reset();
    begin();
  }
  function noteWords() {
    const own = which.value === DESIGNED && isSharpened(job) ? SHARPENED : SURFACES.find(([name]) => name === which.value)[2];
    return [own, focusSentence(job.report)].filter(Boolean).join(" ");
  }
  /** A picture for this lens and this many pixels. A canvas keeps its context, so the memory of the last picture is released. */
  function begin() {
    if (!lens) return;
    picture?.forget();
    picture = lightPicture(canvas, lens, { pixels: Number(fine.value), margin: 1.05 });
    live.hidden = !picture;
    still.hidden = Boolean(picture);
    change();
  }
  function reset() {
    if (!lens) return;
    setting = settingOf(lens);
    setting.slant = [...setting.slant];
    drawRows();
    change();
  }
  function drawRows() {
    const far = lens.throw_mm, lamp = setting.lamp;
    const size = lamp ? Math.max(20, 4 * setting.radius) : Math.max(2, (4 * setting.radius) / RAD);
    sliders = [
      slider(t("Wall"), 0.4 * far, 2 * far, far / 400, () => setting.throwMm, (value) => (setting.throwMm = value), mm),
      slider(t("Block, turned sideways"), -25, 25, 0.25, () => setting.turn[0] / RAD, (value) => (setting.turn[0] = value * RAD), degrees),
      slider(t("Block, tipped"), -25, 25, 0.25, () => setting.turn[1] / RAD, (value) => (setting.turn[1] = value * RAD), degrees),
      slider(lamp ? t("Lamp, aside") : t("Sun, aside"), -25, 25, 0.25, () => Math.atan(setting.slant[0]) / RAD, (value) => (setting.slant[0] = Math.tan(value * RAD)), degrees),
      lamp && slider(t("Lamp, distance"), 0.3 * setting.distanceMm, 3 * setting.distanceMm, setting.distanceMm / 200, () => setting.distanceMm, (value) => (setting.distanceMm = value), mm),
      slider(lamp ? t("Lamp, width") : t("Sun, width"), 0, size, size / 100, () => (2 * setting.radius) / (lamp ? 1 : RAD), (value) => (setting.radius = (value / 2) * (lamp ? 1 : RAD)), lamp ? mm : degrees),
    ].filter(Boolean);
    replace(rows, sliders.map((each) => each.node));
  }
  function slider(name, min, max, step, get, set, say) {
    const id = freshId("light"), value = h("output", { for: id });
    const input = h("input", { id, type: "range", min, max, step, oninput: () => (set(Number(input.value)), change()) });
    const show = () => {
      if (document.activeElement !== input) input.value = get();
      input.setAttribute("aria-valuetext", write(value, say(get())).textContent);
    };
    return { node: h("div", { class: "field" }, h("label", { for: id }, `${name} `, value), input), show };
  }
  function change() {
    for (const each of sliders) each.show();
    const off = setting.throwMm - lens.throw_mm;
    write(words, Math.abs(off) < 1e-3 * lens.throw_mm ? t`Wall at ${mm(setting.throwMm)}, where it belongs` : wallWords(mm(setting.throwMm), mm(Math.abs(off)), off < 0));
    moved = true;
    pending = null;
    ask();
  }
  function ask() {
    if (!frame && picture && !gone && seen.seen() && (moved || pending)) frame = requestAnimationFrame(draw);
  }
  /** A coarse picture at once while something moves; then all of the light on the finest net, as many beams a frame as the graphics card can draw. */
  function draw(time) {
    frame = 0;
    const took = time - last, all = (lens.nx - 1) * (lens.ny - 1), whole = beamCount(lens, setting);
    if (took < QUICK_MS) cells = Math.min(MOST_CELLS, 2 * cells);
    else if (took > SLOW_MS) cells = Math.max(all / 16, took < 2000 ? cells / 2 : cells);
    last = time;
    if (moved) {
      const stride = [1, 2].find((each) => (all / each ** 2) * whole <= cells) ?? 4;
      const beams = beamsOf(lens, setting, Math.max(lens.slopes ? FEW_BEAMS : 1, Math.floor((cells * stride ** 2) / all)));
      picture.add(setting, beams, { whole: beams.length, first: true, stride });
      picture.turnOver();
      moved = false;
      pending = stride === 1 && beams.length === whole ? null : { beams: beamsOf(lens, setting), done: 0 };
    } else {
      const stride = whole > MANY_BEAMS ? 2 : 1, { beams, done } = pending;
      const next = beams.slice(done, done + Math.max(1, Math.floor((cells * stride ** 2) / all)));
      picture.add(setting, next, { whole, first: done === 0, stride });
      pending = done + next.length < whole ? { beams, done: done + next.length } : null;
      if (!pending) picture.turnOver();
      else picture.showAgain();
    }
    ask();
  }
  gestures(canvas, {
    drag(dx, dy) {
      if (!setting) return;
      setting.throwMm = Math.min(2, Math.max(0.4, setting.throwMm / lens.throw_mm - dy / 800)) * lens.throw_mm;
      setting.turn[0] = Math.min(25, Math.max(-25, setting.turn[0] / RAD + dx / 16)) * RAD;
      change();
    },
    zoom() {},
    reset,
  });

  /** The surface that the wall will really show comes first: the latest known one, until a person chooses. */
  function update(artifacts, now) {
    files = artifacts;
    job = now;
    const there = SURFACES.filter(([name]) => artifacts.has(name)), before = which.value;
    node.hidden = there.length === 0;
    if (which.options.length !== there.length) {
      replace(which, there.map(([name, title]) => h("option", { value: name }, title)));
      which.value = chosen ? before : there.at(-1)?.[0];
    }
    seen.again();
  }
  return {
    node, update,
    free() {
      gone = true;
      cancelAnimationFrame(frame);
      seen.end();
      picture?.free();
    },
  };
}

function wallWords(at, off, near) {
  return near ? t`Wall at ${at}: ${off} too near` : t`Wall at ${at}: ${off} too far`;
}

function degrees(value) {
  return `${Number(value.toFixed(2))}°`;
}
