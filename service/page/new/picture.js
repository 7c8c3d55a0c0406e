/**
 * The picture of a new job, and what a person does to it: turn, mirror, choose a part, change tones.
 *
 * All of it happens here, at the picture's full size; an unchanged picture is sent as the original file, with all its
 * bits. Coordinates are pixels of the picture as turned and mirrored, (0, 0) at its upper left.
 */


const PROXY_SIDE = 2048; // the copy for the preview
const MOST_SIDE = 4096; // of the picture that is sent
const SENDABLE_PIXELS = 36e6;
const SENDABLE_BYTES = 48e6;
export const MOST_ZOOM = 12;
export const UNTOUCHED = Object.freeze({
  quarters: 0,
  mirror: false,
  x: 0.5,
  y: 0.5,
  zoom: 1,
  brightness: 0,
  contrast: 0,
});

/** A picture from a file; `shown` is false where this browser cannot decode it: then it is sent as it is. */
export async function openPicture(file) {
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(file);
  } catch {
    return { file, shown: false, width: 0, height: 0 };
  }
  const { width, height } = bitmap;
  return { file, shown: true, width, height, bitmap, proxy: await smaller(bitmap) };
}

async function smaller(bitmap) {
  const scale = PROXY_SIDE / Math.max(bitmap.width, bitmap.height);
  if (scale >= 1) return bitmap;
  const size = {
    resizeWidth: Math.max(1, Math.round(bitmap.width * scale)),
    resizeHeight: Math.max(1, Math.round(bitmap.height * scale)),
  };
  return createImageBitmap(bitmap, { ...size, resizeQuality: "high" });
}

/** Width and height as turned. */
export function sizeOf(picture, { quarters }) {
  return quarters % 2 ? [picture.height, picture.width] : [picture.width, picture.height];
}

/** The part of the picture that a screen of aspect = width / height gets: {x, y, width, height}. */
export function partOf(picture, edits, { aspect, fit }) {
  const [width, height] = sizeOf(picture, edits);
  if (fit !== "crop") return { x: 0, y: 0, width, height };
  const across = Math.min(width, height * aspect) / edits.zoom;
  const down = across / aspect;
  return {
    x: between(edits.x * width - across / 2, width - across),
    y: between(edits.y * height - down / 2, height - down),
    width: across,
    height: down,
  };
}

/** The edits with their centre at the real place of the part, so that no earlier drag beyond the edge has to be undone first. */
export function clampEdits(picture, edits, screen) {
  const [width, height] = sizeOf(picture, edits);
  const part = partOf(picture, edits, { ...screen, fit: "crop" });
  return { ...edits, x: (part.x + part.width / 2) / width, y: (part.y + part.height / 2) / height };
}

/** Draws the part into a box of a canvas: from the full picture, or from its smaller copy for looking at. */
export function paint(context, picture, edits, part, box, { full = false } = {}) {
  const source = full ? picture.bitmap : picture.proxy;
  const [width, height] = sizeOf(picture, edits);
  context.save();
  context.beginPath();
  context.rect(box.x, box.y, box.width, box.height);
  context.clip();
  context.imageSmoothingQuality = "high";
  context.translate(box.x, box.y);
  context.scale(box.width / part.width, box.height / part.height);
  context.translate(-part.x, -part.y);
  if (edits.mirror) context.transform(-1, 0, 0, 1, width, 0);
  turn(context, edits.quarters, width, height);
  context.drawImage(source, 0, 0, picture.width, picture.height);
  context.restore();
}

function turn(context, quarters, width, height) {
  if (quarters === 1) context.transform(0, 1, -1, 0, width, 0);
  if (quarters === 2) context.transform(-1, 0, 0, -1, width, height);
  if (quarters === 3) context.transform(0, -1, 1, 0, 0, height);
}

/** The picture to send: {blob, name}; the file itself if nothing was changed, so that estimate and job share a plan. mostSide: a smaller copy is enough. */
export async function sentPicture(picture, edits, screen, { mostSide = MOST_SIDE } = {}) {
  const { file } = picture;
  const isSmall = mostSide === MOST_SIDE || Math.max(picture.width, picture.height) <= mostSide;
  if (!picture.shown || (isSmall && isUntouched(edits) && isSendable(picture))) return { blob: file, name: file.name };
  const part = partOf(picture, edits, screen);
  const scale = Math.min(1, mostSide / Math.max(part.width, part.height));
  const [width, height] = [part.width, part.height].map((side) => Math.max(1, Math.round(side * scale)));
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d");
  const full = Math.max(part.width, part.height) * picture.proxy.width < mostSide * picture.width; // the smaller copy is not enough
  paint(context, picture, edits, part, { x: 0, y: 0, width, height }, { full });
  if (edits.brightness || edits.contrast) {
    const pixels = context.getImageData(0, 0, width, height);
    bend(pixels.data, curve(edits));
    context.putImageData(pixels, 0, 0);
  }
  return {
    blob: await canvas.convertToBlob({ type: "image/png" }),
    name: `${file.name.replace(/\.[^.]*$/, "")}.png`,
  };
}

export function isUntouched(edits) {
  return Object.entries(UNTOUCHED).every(([key, usual]) => edits[key] === usual);
}

/** Whether the server takes the file as it is, by its usual limits. */
function isSendable({ file, width, height }) {
  return width * height <= SENDABLE_PIXELS && file.size <= SENDABLE_BYTES;
}

function between(value, high) {
  return Math.min(Math.max(0, value), Math.max(0, high));
}

/** Values 0..255 after a change of brightness (-1..1, moves the middle tones) and contrast (-1..1). */
export function curve({ brightness, contrast }) {
  return Uint8ClampedArray.from({ length: 256 }, (_, value) => {
    const moved = (value / 255) ** (2 ** -brightness);
    return 255 * ((moved - 0.5) * 2 ** contrast + 0.5);
  });
}

/** Lays a curve over the colours of RGBA bytes, in place. */
export function bend(rgba, table) {
  for (let at = 0; at < rgba.length; at += 4) {
    rgba[at] = table[rgba[at]];
    rgba[at + 1] = table[rgba[at + 1]];
    rgba[at + 2] = table[rgba[at + 2]];
  }
}
