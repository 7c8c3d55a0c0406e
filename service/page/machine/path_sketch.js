/**
 * Draws the coarse level of a pass's path: once faintly, then over it the lines that are cut. A pass that makes the
 * lens is drawn as wide as its ball, in the colours of the lens's heights; others as a line. The result is kept in a
 * separate picture, so that a new position costs only the lines since the last one.
 */

const POINT = 4; // numbers of a point in the file: shares of x, y, z and time with two bits
const GAP = 2; // bit of the last one: no line leads here
const RAPID = 1;
const LEAST_PX = 3; // wide: the coarse level leaves rows out

export class PathSketch {
  constructor() {
    this.layer = new OffscreenCanvas(1, 1);
    this.clear();
  }

  clear() {
    this.points = this.lens = null;
    this.drawn = "";
  }

  /**
   * path: a PathFile whose coarsest level is there; name: of the pass's program that runs; lens: {picture, x0, y0, dx, dy},
   * a canvas of its nodes with the highest y on top, where this pass makes it.
   */
  take(path, name, lens) {
    this.points = pointsOf(path);
    this.lens = lens;
    this.firstLine = linesBefore(path.head.programs, name);
    this.drawn = "";
  }

  /** Everything under the tool. done: {line, whole}, the last line of this program that is cut, or whether all of it is. */
  draw(canvas, scale, scene, done) {
    const colours = coloursOf(canvas);
    const now = [canvas.width, canvas.height, scale.k, colours.cut, Boolean(this.points)].join();
    if (now !== this.drawn) this.begin(canvas, scale, scene, colours);
    this.drawn = now;
    this.cutUpTo(done, scale, scene, colours);
    const ink = canvas.getContext("2d");
    ink.clearRect(0, 0, canvas.width, canvas.height);
    ink.drawImage(this.layer, 0, 0);
    ink.strokeStyle = colours.ink;
    ink.lineWidth = scale.dense;
    outline(ink, scale, scene.lens);
    ink.stroke();
  }

  begin(canvas, scale, { block, lens }, colours) {
    Object.assign(this.layer, { width: canvas.width, height: canvas.height });
    this.cut = 0;
    const ink = this.layer.getContext("2d");
    ink.lineWidth = scale.dense;
    ink.fillStyle = colours.block;
    ink.strokeStyle = colours.edge;
    box(ink, scale, block);
    ink.fill();
    ink.stroke();
    outline(ink, scale, lens);
    ink.fillStyle = colours.lens;
    ink.fill();
    if (this.points) stroke(ink, scale, this.points, 0, this.points.count, colours.edge);
  }

  cutUpTo({ line, whole }, scale, { radius }, colours) {
    if (!this.points) return;
    const to = whole ? this.points.count : firstAfter(this.points.lines, line + this.firstLine);
    if (to < this.cut) this.cut = 0; // taken back after a fault; a full redraw is not worth it
    if (to > this.cut) {
      const ink = this.layer.getContext("2d"), wide = (2 * radius * scale.k) / scale.dense;
      const [style, width] = this.lens ? [lensPattern(ink, scale, this.lens), Math.max(LEAST_PX, wide)] : [colours.cut, 1.5];
      stroke(ink, scale, this.points, Math.max(0, this.cut - 1), to, style, width);
    }
    this.cut = to;
  }
}

/** The lens's picture where the lens is. */
function lensPattern(ink, { k, x, y }, { picture, x0, y0, dx, dy }) {
  const pattern = ink.createPattern(picture, "no-repeat");
  const [left, top] = [x0 - dx / 2, y0 + (picture.height - 0.5) * dy];
  pattern.setTransform(new DOMMatrix([k * dx, 0, 0, k * dy, x(left), y(top)]));
  return pattern;
}

function linesBefore(programs, name) {
  let lines = 0;
  for (const program of programs) {
    if (program.file === name) break;
    lines += program.lines;
  }
  return lines;
}

/** All points of the coarsest level: {count, x, y, skip, lines}, mm; skip: no cut leads there. */
function pointsOf(path) {
  const { rows, data } = path.levels[0];
  const count = rows.reduce((sum, row) => sum + row.count, 0);
  const found = { count, x: new Float32Array(count), y: new Float32Array(count), skip: new Uint8Array(count), lines: new Float64Array(count) };
  let at = 0;
  rows.forEach((row, number) => {
    const shares = data.get(number);
    for (let k = 0; k < row.count; k += 1, at += 1) {
      const along = (axis) => row.low[axis] + (shares[POINT * k + axis] / 65535) * (row.high[axis] - row.low[axis]);
      found.x[at] = along(0);
      found.y[at] = along(1);
      found.skip[at] = shares[POINT * k + 3] & (GAP | RAPID);
      found.lines[at] = row.line0 + (k / Math.max(1, row.count - 1)) * (row.line1 - row.line0);
    }
  });
  return found;
}

function firstAfter(lines, line) {
  let [low, high] = [0, lines.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (lines[middle] <= line) low = middle + 1;
    else high = middle;
  }
  return low;
}

function stroke(ink, { x, y, dense }, points, from, to, style, width = 1) {
  ink.strokeStyle = style;
  ink.lineWidth = width * dense;
  ink.beginPath();
  for (let k = from; k < to; k += 1) {
    if (k === from || points.skip[k]) ink.moveTo(x(points.x[k]), y(points.y[k]));
    else ink.lineTo(x(points.x[k]), y(points.y[k]));
  }
  ink.stroke();
}

function outline(ink, scale, lens) {
  if (!lens.round) return box(ink, scale, lens);
  const [cx, cy] = [(lens.x0 + lens.x1) / 2, (lens.y0 + lens.y1) / 2];
  ink.beginPath();
  ink.ellipse(scale.x(cx), scale.y(cy), (scale.k * (lens.x1 - lens.x0)) / 2, (scale.k * (lens.y1 - lens.y0)) / 2, 0, 0, 2 * Math.PI);
}

function box(ink, { k, x, y }, { x0, y0, x1, y1 }) {
  ink.beginPath();
  ink.rect(x(x0), y(y1), k * (x1 - x0), k * (y1 - y0));
}

function coloursOf(element) {
  const style = getComputedStyle(element);
  const [block, lens, edge, ink, cut] = ["--sunken", "--raised", "--edge", "--ink", "--accent"].map((name) => style.getPropertyValue(name));
  return { block, lens, edge, ink, cut };
}
