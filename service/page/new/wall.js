/**
 * The picture and its light on the wall, side by side; until that light is known, the picture in its place. Both also
 * select the part of the picture: drag, pinch, use the wheel, or the arrow keys with + and -.
 */

import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { gestures } from "../job/gestures.js";
import { bend, clampEdits, curve, MOST_ZOOM, paint, partOf, sizeOf } from "./picture.js";

const SIDE = 448; // pixels of the longer side

/**
 * {picture, wall: elements, draw()}. state() -> {picture, edits, screen: {aspect, fit, invert}, light}: all that is drawn,
 * light an image of the light on the wall, null while it is not known. onEdit(edits): a person changed it.
 */
export function wall({ state, onEdit }) {
  const canvas = h("canvas", {
    class: "wall",
    tabIndex: 0,
    role: "application",
    "aria-label": t("What the wall will show. Arrow keys choose the part of the picture, plus and minus zoom."),
  });
  const sharp = h("canvas", { class: "sharp", role: "img", "aria-label": t("The part of the picture") });
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

  /** Moves the part by shares of its own size; the picture moves in the other direction. */
  function move(across, down) {
    const { picture, edits, screen } = state();
    const [width, height] = sizeOf(picture, edits);
    const part = partOf(picture, edits, screen);
    edit({ x: edits.x + (across * part.width) / width, y: edits.y + (down * part.height) / height });
  }

  for (const one of [canvas, sharp])
    gestures(one, {
      drag: (dx, dy) => move(-dx / one.clientWidth, -dy / one.clientHeight),
      zoom: (factor) => edit({ zoom: state().edits.zoom * factor }),
      reset: () => edit({ x: 0.5, y: 0.5, zoom: 1 }),
    });
  return { picture: sharp, wall: canvas, draw };
}

/** Draw on `sharp` the part of the picture, on `canvas` the light on the wall or, if it is unknown, the same part. */
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
  canvas.classList.toggle("negative", screen.invert);
  shown.drawImage(light ?? sharp, 0, 0, width, height);
}

/** Where on the canvas the picture lies. */
function boxFor(picture, edits, { aspect, fit }, { width, height }) {
  if (fit !== "pad") return { x: 0, y: 0, width, height };
  const [own, tall] = sizeOf(picture, edits);
  const share = own / tall / aspect;
  const [across, down] = share >= 1 ? [width, height / share] : [width * share, height];
  return { x: (width - across) / 2, y: (height - down) / 2, width: across, height: down };
}
