/**
 * pass-N.path: a tool path in levels from coarse to whole, read by ranges, so that millions of points need not be
 * fetched to see a pass, nor to see a corner of it closely.
 *
 * A level is the path in order of time, cut in chunks; a chunk has a box, a span of time and of program lines, and
 * points of 8 bytes (x, y, z, time as shares of these) that go to the graphics card as they are.
 */
import { headerOf } from "./drawing_file.js";

const BEGINNING = 640 << 10;
const ROW = 48;
const JOIN_GAP = 64 << 10;
export const POINT_BYTES = 8;

/** fetchBytes(from, to) -> ArrayBuffer. Resolves when the coarsest level is there. */
export async function openPath(fetchBytes) {
  const beginning = await fetchBytes(0, BEGINNING);
  const { head } = headerOf(beginning);
  const first = head.levels[0];
  const end = first.offset_bytes + POINT_BYTES * first.points;
  const whole = end <= beginning.byteLength ? beginning : await fetchBytes(0, end);
  const levels = head.levels.map((level) => ({ ...level, rows: null, data: new Map() }));
  levels[0].rows = rowsOf(whole.slice(first.index_offset_bytes, first.index_offset_bytes + ROW * first.chunks));
  levels[0].rows.forEach((row, k) => levels[0].data.set(k, pointsOf(whole, first.offset_bytes, row)));
  return new PathFile(fetchBytes, head, levels);
}

export class PathFile {
  constructor(fetchBytes, head, levels) {
    this.fetchBytes = fetchBytes;
    this.head = head;
    this.levels = levels;
  }

  get lines() {
    return this.head.programs.reduce((sum, program) => sum + program.lines, 0);
  }

  /** The chunks' rows of a level, fetched if they are not known yet. */
  async rows(number, signal) {
    const level = this.levels[number];
    if (!level.rows) {
      const from = level.index_offset_bytes;
      level.rows = rowsOf(await this.fetchBytes(from, from + ROW * level.chunks, signal));
    }
    return level.rows;
  }

  /** Fetch the missing chunks; neighbours in the file with one request. */
  async load(number, chunks, signal) {
    const { rows, data, offset_bytes: base } = this.levels[number];
    const missing = chunks.filter((k) => !data.has(k));
    for (const group of neighbours(missing.map((k) => ({ k, ...span(base, rows[k]) })))) {
      const from = group[0].from;
      const bytes = await this.fetchBytes(from, group.at(-1).to, signal);
      for (const { k } of group) data.set(k, pointsOf(bytes, base - from, rows[k]));
    }
  }

  /** Drop the oldest chunks beyond that many bytes; never the coarsest level. */
  forget(most) {
    for (const level of this.levels.slice(1)) {
      let held = 0;
      for (const points of level.data.values()) held += points.byteLength;
      for (const [k, points] of level.data) {
        if (held <= most) break;
        held -= points.byteLength;
        level.data.delete(k);
      }
    }
  }

  /** Where the tool is at a time (s): {x, y, z, line, rapid}, from the finest points that are here. */
  at(time) {
    for (let number = this.levels.length - 1; number >= 0; number--) {
      const { rows, data } = this.levels[number];
      if (!rows) continue;
      const k = chunkAt(rows, time), points = data.get(k);
      if (points) return placeIn(rows[k], points, time);
    }
    return null;
  }
}

/** The rows of the index. */
function rowsOf(buffer) {
  const found = [], view = new DataView(buffer);
  for (let at = 0; at < buffer.byteLength; at += ROW) {
    const whole = (k) => view.getUint32(at + 4 * k, true), real = (k) => view.getFloat32(at + 16 + 4 * k, true);
    found.push({
      first: whole(0), count: whole(1), line0: whole(2), line1: whole(3),
      low: [real(0), real(1), real(2)], high: [real(3), real(4), real(5)], t0: real(6), t1: real(7),
    });
  }
  return found;
}

/** Points of a chunk as shares (x, y, z, time with two bits), of a buffer whose byte 0 is `base` before the level's. */
function pointsOf(buffer, base, row) {
  const from = base + POINT_BYTES * row.first;
  return new Uint16Array(buffer.slice(from, from + POINT_BYTES * row.count));
}

function span(base, row) {
  const from = base + POINT_BYTES * row.first;
  return { from, to: from + POINT_BYTES * row.count };
}

/** Spans that lie close enough to be one request. */
function neighbours(spans) {
  const groups = [];
  for (const each of spans.sort((a, b) => a.from - b.from)) {
    const last = groups.at(-1);
    if (last && each.from - last.at(-1).to <= JOIN_GAP) last.push(each);
    else groups.push([each]);
  }
  return groups;
}

/** Numbers of the chunks whose boxes meet a rectangle {x0, y0, x1, y1} in mm, and how many points they have. */
export function chunksIn(rows, view) {
  const chunks = [];
  let points = 0;
  rows.forEach(({ low, high, count }, k) => {
    if (high[0] < view.x0 || low[0] > view.x1 || high[1] < view.y0 || low[1] > view.y1) return;
    chunks.push(k);
    points += count;
  });
  return { chunks, points };
}

function chunkAt(rows, time) {
  let low = 0, high = rows.length - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (rows[middle].t1 < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

function placeIn(row, points, time) {
  const when = (k) => row.t0 + ((points[4 * k + 3] >> 2) / 16383) * (row.t1 - row.t0);
  let low = 0, high = row.count - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (when(middle) < time) low = middle + 1;
    else high = middle;
  }
  const before = Math.max(0, low - 1), gap = when(low) - when(before);
  const share = gap > 0 ? Math.min(1, Math.max(0, (time - when(before)) / gap)) : 1;
  const along = (axis) => {
    const from = points[4 * before + axis], to = points[4 * low + axis];
    return row.low[axis] + ((from + (to - from) * share) / 65535) * (row.high[axis] - row.low[axis]);
  };
  const line = Math.round(row.line0 + ((before + share) / Math.max(1, row.count - 1)) * (row.line1 - row.line0));
  return { x: along(0), y: along(1), z: along(2), line, rapid: (points[4 * low + 3] & 1) === 1 };
}
