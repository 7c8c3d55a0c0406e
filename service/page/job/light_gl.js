/**
 * Light through a lens onto a wall, by WebGL2. No events, no clock.
 *
 * The lens is a net of triangles. Each of its nodes is a ray, refracted exactly by the flat face and by the surface; a
 * triangle's light is spread evenly over the triangle that its rays span on the wall, and overlapping triangles add up:
 * optics/caustic.py, with one triangle for two of the server's. Light from a disc, and a surface whose slope errors
 * differ from place to place, are many such *beams* of equal strength.
 *
 * Lengths in mm. The *block*'s frame: as on the mill, but from the middle of the aperture; Z0 is the top of the stock.
 * The *room*'s: the same while nobody turns the block; the wall is its plane z = throw.
 */
import { programOf, release } from "./gl.js";

const BEAMS = 19; // of light from a disc, as the server has it
const COARSE_NODES = 33; // along a side, by which the light on all of the lens is summed up

const RAYS = `#version 300 es
precision highp float;
uniform sampler2D u_nodes; uniform int u_stride; uniform vec4 u_grid, u_wall; uniform mat3 u_turn;
uniform bool u_lamp, u_mirror; uniform vec3 u_source; uniform float u_index, u_face, u_throw; uniform vec2 u_slope;
out vec4 ray; // where it arrives on the wall in pixels, and the light of its part of the lens; -1: it gets lost
vec3 way; // inside the block
vec2 faceAt(vec3 p) {
  way = u_source;
  if (!u_lamp) return p.xy - (p.z - u_face) / way.z * way.xy;
  vec3 from = p - u_source;
  float away = u_face - u_source.z, run = length(from.xy), depth = p.z - u_face, n = u_index;
  way = normalize(from);
  if (u_mirror) return u_source.xy + away / from.z * from.xy;
  float w = run / (away + depth / n);
  for (int k = 0; k < 6; k++) { // Newton: run = away w + depth w / sqrt(n^2 + (n^2 - 1) w^2)
    float root = sqrt(n * n + (n * n - 1.0) * w * w);
    w += (run - away * w - depth * w / root) / (away + depth * n * n / (root * root * root));
  }
  vec2 aside = run > 0.0 ? from.xy / run : vec2(0.0);
  float sine = w / sqrt(1.0 + w * w) / n;
  way = vec3(aside * sine, sqrt(1.0 - sine * sine));
  return u_source.xy + aside * away * w;
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) * u_stride;
  vec4 node = texelFetch(u_nodes, at, 0);
  vec3 p = vec3(u_grid.xy + u_grid.zw * vec2(at), node.x);
  vec2 right = faceAt(p + vec3(u_grid.z, 0.0, u_grid.z * node.y)), up = faceAt(p + vec3(0.0, u_grid.w, u_grid.w * node.z));
  vec2 face = faceAt(p);
  right -= face;
  up -= face;
  float light = abs(right.x * up.y - right.y * up.x) * node.w;
  if (u_lamp) {
    vec2 aside = (face - u_source.xy) / (u_face - u_source.z);
    light *= pow(1.0 + dot(aside, aside), -1.5);
  }
  vec3 normal = normalize(vec3(-node.yz - u_slope, 1.0));
  float cosine = dot(way, normal), inner = 1.0 - u_index * u_index * (1.0 - cosine * cosine);
  vec3 to = u_mirror ? way - 2.0 * cosine * normal : u_index * way + (sqrt(max(inner, 0.0)) - u_index * cosine) * normal;
  bool lost = to.z <= 0.0 || (u_mirror ? cosine >= 0.0 : inner <= 0.0 || cosine <= 0.0);
  p = u_turn * p;
  to = u_turn * to;
  vec2 hit = p.xy + (u_throw - p.z) / to.z * to.xy;
  ray = vec4((hit - u_wall.xy) * u_wall.zw, lost || to.z <= 0.0 ? -1.0 : light, 1.0);
}`;

/** A triangle that is smaller than SMALL of a pixel would mostly fall between them: its light goes into one of them. */
const SPREAD = `#version 300 es
precision highp float;
const float SMALL = 0.0625;
uniform sampler2D u_rays; uniform int u_cells; uniform vec2 u_pixels; uniform float u_share;
flat out float v_light;
void main() {
  int triangle = gl_VertexID / 3, corner = gl_VertexID % 3;
  ivec2 at = ivec2(triangle / 2 % u_cells, triangle / 2 / u_cells);
  vec3 a = texelFetch(u_rays, at, 0).xyz, c = texelFetch(u_rays, at + 1, 0).xyz;
  vec3 b = texelFetch(u_rays, at + (triangle % 2 == 0 ? ivec2(1, 0) : ivec2(0, 1)), 0).xyz;
  vec2 ab = b.xy - a.xy, ac = c.xy - a.xy, place = corner == 0 ? a.xy : corner == 1 ? b.xy : c.xy;
  float area = 0.5 * abs(ab.x * ac.y - ab.y * ac.x);
  if (area < SMALL) {
    area = 1.0;
    place = floor((a + b + c).xy / 3.0) + vec2(corner == 1 ? 1.1 : 0.2, corner == 2 ? 1.1 : 0.2);
  }
  v_light = (a.z + b.z + c.z) * u_share / area;
  gl_Position = min(a.z, min(b.z, c.z)) < 0.0 ? vec4(2.0, 2.0, 2.0, 1.0) : vec4(2.0 * place / u_pixels - 1.0, 0.0, 1.0);
}`;

const ADD = `#version 300 es
precision highp float;
flat in float v_light; out vec4 light;
void main() { light = vec4(v_light); }`;

const ALL = `#version 300 es
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

const SHOW = `#version 300 es
precision highp float;
uniform sampler2D u_light; uniform float u_white; uniform bool u_turned;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (u_turned) at.x = textureSize(u_light, 0).x - 1 - at.x;
  float sum = 0.0; // of the light that triangles smaller than a pixel left as specks
  for (int k = 0; k < 9; k++) {
    ivec2 off = ivec2(k % 3, k / 3) - 1;
    sum += float((2 - abs(off.x)) * (2 - abs(off.y))) / 16.0 * texelFetch(u_light, clamp(at + off, ivec2(0), textureSize(u_light, 0) - 1), 0).r;
  }
  float light = clamp(sum / u_white, 0.0, 1.0);
  colour = vec4(vec3(light <= 0.0031308 ? 12.92 * light : 1.055 * pow(light, 1.0 / 2.4) - 0.055), 1.0);
}`;

/** The set-up for which the lens was made: {throwMm, turn, lamp, distanceMm, slant, radius}. */
export function settingOf({ throw_mm, light }) {
  const lamp = light.distance_mm !== null;
  return { throwMm: throw_mm, turn: [0, 0], lamp, distanceMm: light.distance_mm ?? 1000, slant: light.slant, radius: light.radius };
}

/**
 * The beams of a setting, `count` of them at most: {source, lamp, slope}, the source in the block's frame.
 *
 * setting: throwMm; turn: [about the upright, about the level axis] of the block, radians; lamp: at distanceMm from the
 * face, or else infinitely far; slant: tangents of the angle of the light against the axis; radius: of its disc, mm of a
 * lamp, radians of a disc of directions.
 */
export function beamsOf(lens, setting, count = Infinity) {
  const many = Math.min(count, beamCount(lens, setting)), back = transposed(turnOf(setting)), mirror = lens.is_mirror;
  const sign = mirror ? -1 : 1, index = mirror ? 1 : lens.refractive_index, face = faceOf(lens);
  const asides = setting.radius > 0 ? discPoints(many) : null, slopes = lens.slopes ?? [[0, 0]];
  const step = coprimeTo(many);
  return Array.from({ length: many }, (_, k) => {
    const [x, y] = asides?.[(k * step) % many] ?? [0, 0];
    const slope = slopes[Math.floor(((k + 0.5) * slopes.length) / many)];
    const aside = [0, 1].map((axis) => setting.radius * (axis ? y : x));
    if (setting.lamp) {
      const place = [0, 1].map((axis) => -setting.distanceMm * setting.slant[axis] + aside[axis]);
      return { lamp: true, slope, source: times(back, [...place, face - sign * setting.distanceMm]) };
    }
    const [dx, dy] = times(back, unit([setting.slant[0] + aside[0], setting.slant[1] + aside[1], sign]));
    const inside = [dx / index, dy / index]; // the flat face keeps n times the sine
    return { lamp: false, slope, source: [...inside, sign * Math.sqrt(1 - inside[0] ** 2 - inside[1] ** 2)] };
  });
}

/** The number of beams that make all of a setting's light. */
export function beamCount(lens, setting) {
  return Math.max(setting.radius > 0 ? BEAMS : 1, lens.slopes?.length ?? 1);
}

/** Where a beam's ray to p = [x, y, z] crossed the face, and how strong it was: [x, y, strength]. */
function meet(lens, beam, p) {
  const face = faceOf(lens), [sx, sy, sz] = beam.source, n = lens.refractive_index;
  if (!beam.lamp) return [p[0] - ((p[2] - face) / sz) * sx, p[1] - ((p[2] - face) / sz) * sy, 1];
  const away = face - sz, from = [p[0] - sx, p[1] - sy, p[2] - sz], run = Math.hypot(from[0], from[1]);
  let reach = (away / from[2]) * run;
  if (!lens.is_mirror) {
    const depth = p[2] - face;
    let w = run / (away + depth / n);
    for (let k = 0; k < 6; k++) {
      const root = Math.sqrt(n * n + (n * n - 1) * w * w);
      w += (run - away * w - (depth * w) / root) / (away + (depth * n * n) / root ** 3);
    }
    reach = away * w;
  }
  const share = run ? reach / run : 0;
  return [sx + share * from[0], sy + share * from[1], (1 + (reach / away) ** 2) ** -1.5];
}

/** From the block's frame to the room's, row by row. */
function turnOf({ turn: [upright, level] }) {
  const [a, b] = [Math.cos(upright), Math.sin(upright)], [c, d] = [Math.cos(level), Math.sin(level)];
  return [a, b * d, b * c, 0, c, -d, -b, a * d, a * c];
}

/** @param {number[]} m @param {number[]} v */
function times(m, [x, y, z]) {
  return [0, 3, 6].map((row) => m[row] * x + m[row + 1] * y + m[row + 2] * z);
}

/** Node (i, j) of the lens in the block's frame: {p, weight}. */
function nodeOf({ nx, ny, dx_mm, dy_mm, nodes }, i, j) {
  const at = 4 * (j * nx + i);
  return { p: [(i - (nx - 1) / 2) * dx_mm, (j - (ny - 1) / 2) * dy_mm, nodes[at]], weight: nodes[at + 3] };
}

function faceOf({ is_mirror, thickness_mm }) {
  return is_mirror ? 0 : -thickness_mm;
}

/** Light on all of the lens, in mm^2 of the face under the strongest light. */
function lightOn(lens, beam) {
  const pick = (count, k) => Math.round((k * (count - 1)) / (COARSE_NODES - 1));
  const lit = Array.from({ length: COARSE_NODES ** 2 }, (_, k) => {
    const { p, weight } = nodeOf(lens, pick(lens.nx, k % COARSE_NODES), pick(lens.ny, Math.floor(k / COARSE_NODES)));
    const [x, y, strength] = meet(lens, beam, p);
    return [x, y, strength * weight];
  });
  let sum = 0;
  for (let j = 0; j < COARSE_NODES - 1; j++) {
    for (let i = 0; i < COARSE_NODES - 1; i++) {
      const [a, b, c, d] = [0, 1, COARSE_NODES, COARSE_NODES + 1].map((next) => lit[j * COARSE_NODES + i + next]);
      const area = ((d[0] - a[0]) * (c[1] - b[1]) - (d[1] - a[1]) * (c[0] - b[0])) / 2;
      sum += (Math.abs(area) * (a[2] + b[2] + c[2] + d[2])) / 4;
    }
  }
  return sum;
}

/** `count` points that share a disc of radius 1 evenly, as optics/light.py has them. */
function discPoints(count) {
  if (count === 1) return [[0, 0]];
  const points = Array.from({ length: count }, (_, k) => {
    const radius = Math.sqrt((k + 0.5) / count), angle = (k + 0.5) * Math.PI * (3 - Math.sqrt(5));
    return [radius * Math.cos(angle), radius * Math.sin(angle)];
  });
  const middle = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / count);
  return points.map(([x, y]) => [x - middle[0], y - middle[1]]);
}

/** A step through a ring of `count` places that visits all of them, far apart. */
function coprimeTo(count) {
  const divisor = (a, b) => (b ? divisor(b, a % b) : a);
  let step = Math.max(1, Math.round(count * 0.618));
  while (divisor(step, count) !== 1) step += 1;
  return step;
}

function transposed(m) {
  return [0, 3, 6, 1, 4, 7, 2, 5, 8].map((at) => m[at]);
}

function unit(way) {
  const length = Math.hypot(...way);
  return way.map((each) => each / length);
}

/**
 * The light of a lens on its wall, kept in two pictures of `pixels` along the wall's longer side, the one shown and the
 * one being made; null if the browser cannot.
 *
 * margin: how much more of the wall is seen than the lens was made for, as a factor.
 */
export function lightPicture(canvas, lens, { pixels = 512, margin = 1 } = {}) {
  const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
  if (!gl?.getExtension("EXT_color_buffer_float")) return null;
  const { nx, ny, dx_mm: dx, dy_mm: dy, is_mirror: mirror } = lens, [wide, high, shiftX, shiftY] = lens.screen_mm;
  const width = Math.round((pixels * wide) / Math.max(wide, high)), height = Math.round((pixels * high) / Math.max(wide, high));
  Object.assign(canvas, { width, height });
  const [rays, spread, show] = [[ALL, RAYS], [SPREAD, ADD], [ALL, SHOW]].map(([vertex, fragment]) => {
    const program = programOf(gl, vertex, fragment), known = {};
    return { use: () => gl.useProgram(program), at: (name) => (known[name] ??= gl.getUniformLocation(program, name)) };
  });
  const nodes = pictureOf(gl, nx, ny, [gl.RGBA32F, gl.RGBA, gl.FLOAT], lens.nodes);
  const arrivals = targetOf(gl, nx, ny, [gl.RGBA32F, gl.RGBA, gl.FLOAT]);
  const walls = [0, 1].map(() => targetOf(gl, width, height, [gl.R16F, gl.RED, gl.HALF_FLOAT]));
  const perPixel = [(wide * margin) / width, (high * margin) / height];
  let shown = 0;

  rays.use();
  gl.uniform4f(rays.at("u_grid"), (-(nx - 1) / 2) * dx, (-(ny - 1) / 2) * dy, dx, dy);
  gl.uniform4f(rays.at("u_wall"), shiftX - (wide * margin) / 2, shiftY - (high * margin) / 2, 1 / perPixel[0], 1 / perPixel[1]);
  gl.uniform1i(rays.at("u_mirror"), mirror);
  gl.uniform1f(rays.at("u_index"), mirror ? 1 : lens.refractive_index);
  spread.use();
  gl.uniform2f(spread.at("u_pixels"), width, height);

  /**
   * Adds beams to the picture that is being made. whole: how many there will be; first: these are the first of them;
   * stride: of the net, 1, 2 or 4 nodes.
   */
  function add(setting, beams, { whole, first, stride = 1 }) {
    const [columns, rows] = [nx, ny].map((count) => (count - 1) / stride + 1), cells = (columns - 1) * (rows - 1);
    const share = (wide * high) / (perPixel[0] * perPixel[1] * lightOn(lens, beams[0]) * whole);
    rays.use();
    gl.uniformMatrix3fv(rays.at("u_turn"), true, turnOf(setting));
    gl.uniform1f(rays.at("u_throw"), setting.throwMm);
    gl.uniform1f(rays.at("u_face"), faceOf(lens));
    gl.uniform1i(rays.at("u_lamp"), setting.lamp);
    gl.uniform1i(rays.at("u_stride"), stride);
    spread.use();
    gl.uniform1i(spread.at("u_cells"), columns - 1);
    gl.uniform1f(spread.at("u_share"), (share * stride * stride) / 6);
    beams.forEach((beam, k) => {
      arrivals.into(columns, rows);
      nodes.use();
      rays.use();
      gl.uniform3fv(rays.at("u_source"), beam.source);
      gl.uniform2fv(rays.at("u_slope"), beam.slope);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      walls[1 - shown].into(width, height);
      if (first && k === 0) gl.clear(gl.COLOR_BUFFER_BIT);
      arrivals.use();
      spread.use();
      gl.enable(gl.BLEND);
      gl.blendFunc(gl.ONE, gl.ONE);
      gl.drawArrays(gl.TRIANGLES, 0, 6 * cells);
      gl.disable(gl.BLEND);
    });
  }
  /** Show the picture that was being made. */
  function turnOver() {
    shown = 1 - shown;
    showAgain();
  }
  function showAgain() {
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    walls[shown].use();
    show.use();
    gl.uniform1f(show.at("u_white"), lens.white);
    gl.uniform1i(show.at("u_turned"), lens.viewed_from === "lens");
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }
  /** Irradiance as shown, in the work frame, row 0 at the lowest y: {nx, ny, values}. */
  function read() {
    walls[shown].into(width, height);
    const values = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
    return { nx: width, ny: height, values: values.filter((_, k) => k % 4 === 0) };
  }
  /** Gives back the memory of this picture, not the canvas: another may be made on it. */
  function forget() {
    for (const one of [nodes, arrivals, ...walls]) gl.deleteTexture(one.texture);
  }
  return { add, turnOver, showAgain, read, forget, free: () => release(gl) };
}

/** A picture in the browser's memory: {texture, use()}. */
function pictureOf(gl, width, height, [inside, format, kind], content = null) {
  const texture = gl.createTexture(), use = () => gl.bindTexture(gl.TEXTURE_2D, texture);
  use();
  gl.texImage2D(gl.TEXTURE_2D, 0, inside, width, height, 0, format, kind, content);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  return { texture, use };
}

/** One that can be drawn into: into(columns, rows) does, its lower left part. */
function targetOf(gl, width, height, format) {
  const picture = pictureOf(gl, width, height, format), frame = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
  gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, picture.texture, 0);
  return {
    ...picture,
    into(columns, rows) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
      gl.viewport(0, 0, columns, rows);
    },
  };
}
