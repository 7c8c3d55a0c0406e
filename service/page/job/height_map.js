/** The lens from above as colours, with contour lines, on a plain canvas. */
import { extremes, heightColour } from "./surface.js";

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
