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

/**
 * light*.bin: its header as it is, with `nodes`: height from the top of the block (mm), slopes in x and y, and share of
 * the light of every node, one after the other, row 0 at the lowest y.
 */
export async function lightOf(packed) {
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const buffer = await new Response(stream).arrayBuffer();
  const { head, start } = headerOf(buffer), { nx, ny } = head, size = nx * ny;
  const levels = new Int32Array(buffer, start, size), nodes = new Float32Array(4 * size);
  const weights = head.weighted ? new Uint8Array(buffer, start + 4 * size, size) : null;
  for (let at = 0; at < size; at++) {
    const left = at % nx ? levels[at - 1] : 0, below = at < nx ? 0 : levels[at - nx];
    levels[at] += left + below - (at % nx && at >= nx ? levels[at - nx - 1] : 0);
    nodes[4 * at] = head.z0_mm + head.dz_mm * levels[at];
    nodes[4 * at + 3] = weights ? weights[at] / 255 : 1;
  }
  for (let j = 0; j < ny; j++) slopesAlong(levels, j * nx, 1, nx, (at, slope) => (nodes[4 * at + 1] = slope * head.dz_mm / head.dx_mm));
  for (let i = 0; i < nx; i++) slopesAlong(levels, i, nx, ny, (at, slope) => (nodes[4 * at + 2] = slope * head.dz_mm / head.dy_mm));
  return { ...head, nodes };
}

/** Slopes per step of the cubic spline through `count` values from `first` on, each `stride` on, as optics/spline.py has it. */
function slopesAlong(values, first, stride, count, put) {
  const f = (i) => values[first + i * stride], n = count, c = new Float64Array(n + 2), ratio = new Float64Array(n);
  c[2] = f(1) - (f(0) - 2 * f(1) + f(2)) / 6;
  c[n - 1] = f(n - 2) - (f(n - 1) - 2 * f(n - 2) + f(n - 3)) / 6;
  for (let i = 2; i < n - 2; i++) {
    ratio[i] = 1 / (4 - ratio[i - 1]);
    c[i + 1] = (6 * f(i) - c[i]) * ratio[i];
  }
  for (let i = n - 3; i > 1; i--) c[i + 1] -= ratio[i] * c[i + 2];
  c[1] = 6 * f(1) - 4 * c[2] - c[3];
  c[0] = 6 * f(0) - 4 * c[1] - c[2];
  c[n] = 6 * f(n - 2) - 4 * c[n - 1] - c[n - 2];
  c[n + 1] = 6 * f(n - 1) - 4 * c[n] - c[n - 1];
  for (let i = 0; i < n; i++) put(first + i * stride, (c[i + 2] - c[i]) / 2);
}
