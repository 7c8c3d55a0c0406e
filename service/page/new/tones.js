/** Pixels as light: converts a picture's values to light, and light to what a wall shows. The same formulas as the server's. */

const LUMINANCE = [0.2126, 0.7152, 0.0722]; // Rec. 709, in linear light
const FROM_SRGB = Float32Array.from({ length: 256 }, (_, value) => toLinear(value / 255));
const AS_THEY_ARE = Float32Array.from({ length: 256 }, (_, value) => value / 255);
const STEPS = 4096;
const TO_SRGB = Uint8ClampedArray.from({ length: STEPS + 1 }, (_, step) => 255 * toSrgb(step / STEPS));

/** IEC 61966-2-1, for values in [0, 1]. */
export function toLinear(encoded) {
  return encoded <= 0.04045 ? encoded / 12.92 : ((encoded + 0.055) / 1.055) ** 2.4;
}

/** IEC 61966-2-1, for values in [0, 1]. */
export function toSrgb(linear) {
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}

/** Light [0, 1] of each pixel of RGBA bytes; tone "srgb" or "linear"; `invert`: the negative in its own tones. */
export function lightOf(rgba, { tone, invert }) {
  const table = tone === "linear" ? AS_THEY_ARE : FROM_SRGB;
  const light = new Float32Array(rgba.length / 4);
  for (let pixel = 0; pixel < light.length; pixel += 1) {
    const at = 4 * pixel;
    const sum =
      LUMINANCE[0] * table[rgba[at]] + LUMINANCE[1] * table[rgba[at + 1]] + LUMINANCE[2] * table[rgba[at + 2]];
    light[pixel] = invert ? negative(sum, tone) : sum;
  }
  return light;
}

function negative(light, tone) {
  return tone === "linear" ? 1 - light : toLinear(1 - toSrgb(Math.min(1, light)));
}

/** Light [0, 1] as grey RGBA bytes for a screen. */
export function greyOf(light) {
  const rgba = new Uint8ClampedArray(4 * light.length);
  for (let pixel = 0; pixel < light.length; pixel += 1) {
    const grey = TO_SRGB[Math.round(STEPS * Math.min(1, Math.max(0, light[pixel])))];
    rgba.fill(grey, 4 * pixel, 4 * pixel + 3);
    rgba[4 * pixel + 3] = 255;
  }
  return rgba;
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
