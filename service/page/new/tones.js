/** Brightness and contrast of a picture's pixels. */

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
