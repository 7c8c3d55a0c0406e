/**
 * The picture and the light that the wall will show of it, side by side; until that light is known, the picture. Either is where the part of the picture is
 * chosen, too: drag it, pinch it, use the wheel, or the arrow keys with + and -.
 */

import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { MOST_ZOOM, paint, partOf, clampEdits, sizeOf } from "./picture.js";
import { bend, curve, greyOf, lightOf } from "./tones.js";

const SIDE = 448; // pixels of the longer side
const KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEY_STEP = 0.05; // of the part
const ZOOM_STEP = 1.15;

/**
 * {picture, wall: elements, draw()}. state() -> {picture, edits, screen: {aspect, fit, tone, invert}, light}: all that is drawn,
 * light an image of the light on the wall, null while it is not known. onEdit(edits): a person changed it.
 */
export function wall({ state, onEdit }) {
  const canvas = h("canvas", {
    class: "wall",
    tabIndex: 0,
    role: "application",
    "aria-label": t("What the wall will show. Arrow keys choose the part of the picture, plus and minus zoom."),
    onkeydown: onKey,
    onwheel: onWheel,
  });
  const sharp = h("canvas", { class: "sharp", role: "img", "aria-label": t("The part of the picture"), onwheel: onWheel });
  let asked = 0;

  function draw() {
    asked ||= requestAnimationFrame(() => {
      asked = 0;
      if (!canvas.isConnected || !state().picture?.shown) return;
      drawWall(canvas, sharp, state());
      for (const one of [canvas, sharp]) one.classList.toggle("movable", state().screen.fit === "crop");
    });
  }

  function edit(change) {
    const { picture, edits, screen } = state();
    if (!picture?.shown || screen.fit !== "crop") return;
    const wanted = { ...edits, ...change };
    onEdit(clampEdits(picture, { ...wanted, zoom: Math.min(MOST_ZOOM, Math.max(1, wanted.zoom)) }, screen));
  }

  /** Moves the part by shares of itself, seen from the part: the picture moves the other way. */
  function move(across, down) {
    const { picture, edits, screen } = state();
    const [width, height] = sizeOf(picture, edits);
    const part = partOf(picture, edits, screen);
    edit({ x: edits.x + (across * part.width) / width, y: edits.y + (down * part.height) / height });
  }

  function onKey(event) {
    const way = KEYS[event.key];
    const zoom = { "+": ZOOM_STEP, "=": ZOOM_STEP, "-": 1 / ZOOM_STEP }[event.key];
    if (event.ctrlKey || event.metaKey || event.altKey || !(way || zoom)) return;
    event.preventDefault();
    if (way) move(KEY_STEP * way[0], KEY_STEP * way[1]);
    else edit({ zoom: state().edits.zoom * zoom });
  }

  /** The wheel zooms once the wall has the focus; before that it scrolls the page. */
  function onWheel(event) {
    if (document.activeElement !== canvas && !event.ctrlKey) return;
    event.preventDefault();
    edit({ zoom: state().edits.zoom * Math.exp(-event.deltaY / 400) });
  }

  for (const one of [canvas, sharp])
    dragAndPinch(one, {
      onDrag: (across, down) => move(-across, -down),
      onPinch: (ratio) => edit({ zoom: state().edits.zoom * ratio }),
    });
  return { picture: sharp, wall: canvas, draw };
}

/** Draw on `sharp` the part of the picture, on `canvas` the light on the wall or, if it is unknown, its target. */
function drawWall(canvas, sharp, { picture, edits, screen, light }) {
  const [width, height] = [Math.min(1, screen.aspect), Math.min(1, 1 / screen.aspect)].map((share) => Math.max(1, Math.round(SIDE * share)));
  const [context, shown] = [sharp, canvas].map((one) => {
    if (one.width !== width || one.height !== height) Object.assign(one, { width, height });
    return one.getContext("2d", { willReadFrequently: true });
  });
  const box = boxFor(picture, edits, screen, { width, height });
  context.fillStyle = "#000";
  context.fillRect(0, 0, width, height);
  context.fillStyle = "#fff"; // transparent parts lie over white
  context.fillRect(box.x, box.y, box.width, box.height);
  paint(context, picture, edits, partOf(picture, edits, screen), box);
  const pixels = context.getImageData(0, 0, width, height);
  if (edits.brightness || edits.contrast) bend(pixels.data, curve(edits));
  context.putImageData(pixels, 0, 0);
  canvas.classList.toggle("known", light !== null);
  if (light) return shown.drawImage(light, 0, 0, width, height);
  const asked = lightOf(pixels.data, screen);
  darken(asked, box, width, height);
  pixels.data.set(greyOf(asked));
  shown.putImageData(pixels, 0, 0);
}

/** Where on the canvas the picture lies. */
function boxFor(picture, edits, { aspect, fit }, { width, height }) {
  if (fit !== "pad") return { x: 0, y: 0, width, height };
  const [own, tall] = sizeOf(picture, edits);
  const share = own / tall / aspect;
  const [across, down] = share >= 1 ? [width, height / share] : [width * share, height];
  return { x: (width - across) / 2, y: (height - down) / 2, width: across, height: down };
}

/** No light beside the picture, in a negative neither. */
function darken(light, box, width, height) {
  if (box.width === width && box.height === height) return;
  for (let row = 0; row < height; row += 1) {
    for (let column = 0; column < width; column += 1) {
      const inside =
        column + 0.5 > box.x &&
        column + 0.5 < box.x + box.width &&
        row + 0.5 > box.y &&
        row + 0.5 < box.y + box.height;
      if (!inside) light[row * width + column] = 0;
    }
  }
}

/** One pointer drags (shares of the element), two pinch (ratio of their distances). */
function dragAndPinch(element, { onDrag, onPinch }) {
  const pointers = new Map();
  const apart = () => {
    const [one, other] = [...pointers.values()];
    return Math.hypot(one.x - other.x, one.y - other.y);
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  element.addEventListener("pointermove", (event) => {
    const from = pointers.get(event.pointerId);
    if (!from) return;
    const before = pointers.size === 2 ? apart() : 0;
    const { width, height } = element.getBoundingClientRect();
    if (pointers.size === 1) onDrag((event.clientX - from.x) / width, (event.clientY - from.y) / height);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before > 0) onPinch(apart() / before);
  });
  for (const end of ["pointerup", "pointercancel"])
    element.addEventListener(end, (event) => pointers.delete(event.pointerId));
}
