/** The lens surface as numbers: heights anywhere, lowest and highest, slopes, and the triangles that show it. */

/** Height in mm at x, y (mm), between the nodes of the grid; null beside it. */
export function heightAt(grid, x, y) {
  const u = (x - grid.x0) / grid.dx, v = (y - grid.y0) / grid.dy;
  if (u < 0 || v < 0 || u > grid.nx - 1 || v > grid.ny - 1) return null;
  const i = Math.min(grid.nx - 2, Math.floor(u)), j = Math.min(grid.ny - 2, Math.floor(v));
  const a = u - i, b = v - j, at = j * grid.nx + i, s = grid.steps;
  const low = s[at] * (1 - a) + s[at + 1] * a;
  const high = s[at + grid.nx] * (1 - a) + s[at + grid.nx + 1] * a;
  return grid.z0 + grid.dz * (low * (1 - b) + high * b);
}

/** Lowest and highest node, in mm. */
export function extremes(grid) {
  let low = Infinity, high = -Infinity;
  for (const step of grid.steps) {
    if (step < low) low = step;
    if (step > high) high = step;
  }
  return { low: grid.z0 + grid.dz * low, high: grid.z0 + grid.dz * high };
}

/** x, y, z, dz/dx and dz/dy of every node, one after the other; x and y from the middle of the lens. */
export function vertices(grid) {
  const { nx, ny, steps, dz } = grid;
  const found = new Float32Array(nx * ny * 5);
  for (let j = 0, at = 0; j < ny; j++) {
    const up = Math.min(j + 1, ny - 1), down = Math.max(j - 1, 0);
    for (let i = 0; i < nx; i++, at += 5) {
      const right = Math.min(i + 1, nx - 1), left = Math.max(i - 1, 0);
      found[at] = (i - (nx - 1) / 2) * grid.dx;
      found[at + 1] = (j - (ny - 1) / 2) * grid.dy;
      found[at + 2] = grid.z0 + dz * steps[j * nx + i];
      found[at + 3] = (dz * (steps[j * nx + right] - steps[j * nx + left])) / ((right - left) * grid.dx);
      found[at + 4] = (dz * (steps[up * nx + i] - steps[down * nx + i])) / ((up - down) * grid.dy);
    }
  }
  return found;
}

/** Corners of the triangles, two for each mesh of the grid, anticlockwise from above. */
export function triangles(nx, ny) {
  const found = new Uint32Array((nx - 1) * (ny - 1) * 6);
  for (let j = 0, at = 0; j < ny - 1; j++) {
    for (let i = 0; i < nx - 1; i++, at += 6) {
      const a = j * nx + i;
      found.set([a, a + 1, a + nx, a + 1, a + nx + 1, a + nx], at);
    }
  }
  return found;
}

/** The walls of the block around the lens, from its rim down to `floor` (mm): x, y, z of triangles. */
export function walls(grid, floor) {
  const { nx, ny } = grid, rim = [];
  for (let i = 0; i < nx - 1; i++) rim.push([i, 0]);
  for (let j = 0; j < ny - 1; j++) rim.push([nx - 1, j]);
  for (let i = nx - 1; i > 0; i--) rim.push([i, ny - 1]);
  for (let j = ny - 1; j > 0; j--) rim.push([0, j]);
  const point = (/** @type {number[]} */ [i, j]) => [
    (i - (nx - 1) / 2) * grid.dx, (j - (ny - 1) / 2) * grid.dy, grid.z0 + grid.dz * grid.steps[j * nx + i],
  ];
  const found = [];
  rim.forEach((node, k) => {
    const [ax, ay, az] = point(node), [bx, by, bz] = point(rim[(k + 1) % rim.length]);
    found.push(ax, ay, floor, bx, by, floor, ax, ay, az, bx, by, floor, bx, by, bz, ax, ay, az);
  });
  return new Float32Array(found);
}

const STOPS = [[20, 30, 82], [28, 94, 146], [63, 154, 152], [156, 203, 145], [252, 246, 198]];

/** Colour of a share 0..1 from low to high: dark blue to pale yellow, brighter all the way, for any kind of sight. */
export function heightColour(share) {
  const at = Math.min(1, Math.max(0, share)) * (STOPS.length - 1);
  const k = Math.min(STOPS.length - 2, Math.floor(at)), t = at - k;
  return STOPS[k].map((low, c) => Math.round(low + (STOPS[k + 1][c] - low) * t));
}

const LINES = 8;

/** Colours of all nodes, row 0 on top: an ImageData of nx x ny. */
export function heightPicture(grid) {
  const { low, high } = extremes(grid);
  const { nx, ny } = grid, span = Math.max(high - low, 1e-9);
  const picture = new ImageData(nx, ny);
  const share = (i, j) => (grid.z0 + grid.dz * grid.steps[j * nx + i] - low) / span;
  for (let j = 0; j < ny; j++) {
    for (let i = 0; i < nx; i++) {
      const here = share(i, j), colour = heightColour(here);
      const level = Math.floor(here * LINES);
      const crosses = Math.floor(share(Math.min(i + 1, nx - 1), j) * LINES) !== level
        || Math.floor(share(i, Math.min(j + 1, ny - 1)) * LINES) !== level;
      const dim = crosses ? 0.72 : 1;
      const at = ((ny - 1 - j) * nx + i) * 4;
      for (let c = 0; c < 3; c++) picture.data[at + c] = colour[c] * dim;
      picture.data[at + 3] = 255;
    }
  }
  return picture;
}
