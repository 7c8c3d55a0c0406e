/** Files made for drawing: one line of JSON padded to a multiple of 8 bytes, then arrays, little-endian. */

/** The header and where the arrays begin: {head, start}. */
export function headerOf(buffer) {
  const bytes = new Uint8Array(buffer);
  const end = bytes.indexOf(10);
  if (end < 0) throw new Error("this file has no header line");
  return { head: JSON.parse(new TextDecoder().decode(bytes.subarray(0, end))), start: end + 1 };
}

/**
 * surface.bin as a grid of heights: {nx, ny, x0, y0, dx, dy, z0, dz, steps}, lengths in mm, row 0 at the lowest y;
 * height of a node = z0 + dz * step.
 */
export function surfaceOf(buffer) {
  const { head, start } = headerOf(buffer);
  const steps = new Uint16Array(buffer, start, head.nx * head.ny);
  return {
    nx: head.nx, ny: head.ny, x0: head.x0_mm, y0: head.y0_mm, dx: head.dx_mm, dy: head.dy_mm,
    z0: head.z0_mm, dz: head.dz_mm, steps,
  };
}

/** focus.bin: {nx, ny, factors, throwMm, frame(k)}; a frame is grey, as a person sees it, row 0 on top. */
export function focusOf(buffer) {
  const { head, start } = headerOf(buffer);
  const size = head.nx * head.ny;
  return {
    nx: head.nx, ny: head.ny, factors: head.factors, throwMm: head.throw_mm,
    frame: (k) => new Uint8Array(buffer, start + k * size, size),
  };
}
