/** Chunks of a tool path as lines, drawn by WebGL2 straight from the file's points. */
import { programOf, release } from "./gl.js";
import { POINT_BYTES } from "./path_file.js";

const MOST_BYTES = 96 << 20; // of points on the card
const WIDE_SEGMENTS = 120_000; // up to this count lines have their full width, beyond it the least width

const VERTEX = `#version 300 es
layout(location = 0) in uvec4 a_from; layout(location = 1) in uvec4 a_to;
uniform vec3 u_low, u_size, u_seconds; uniform vec2 u_middle, u_scale, u_pixel; uniform vec2 u_depth;
uniform float u_half; uniform bool u_rapids;
out float v_time; out float v_share; flat out uint v_rapid;
vec2 screen(uvec4 point) { return (u_low.xy + vec2(point.xy) / 65535.0 * u_size.xy - u_middle) * u_scale; }
float seconds(uvec4 point) { return u_seconds.x + float(point.w >> 2u) / 16383.0 * (u_seconds.y - u_seconds.x); }
void main() {
  v_rapid = a_to.w & 1u;
  bool left_out = (a_to.w & 2u) != 0u || (v_rapid == 1u && !u_rapids);
  vec2 from = screen(a_from), to = screen(a_to), way = (to - from) / u_pixel;
  float reach = length(way);
  vec2 along = reach > 0.0 ? way / reach : vec2(1.0, 0.0);
  float end = float(gl_VertexID & 1), side = float(gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 aside = (vec2(-along.y, along.x) * side + along * (end * 2.0 - 1.0) * 0.5) * u_half * u_pixel;
  uvec4 here = end > 0.5 ? a_to : a_from;
  v_time = seconds(here);
  v_share = clamp((u_low.z + float(here.z) / 65535.0 * u_size.z - u_depth.x) / (u_depth.y - u_depth.x), 0.0, 1.0);
  float layer = seconds(a_to) <= u_seconds.z ? 0.0 : 0.5;
  gl_Position = left_out ? vec4(2.0, 2.0, 2.0, 1.0) : vec4((end > 0.5 ? to : from) + aside, layer, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 u_deep, u_high, u_coming, u_rapid; uniform float u_now;
in float v_time; in float v_share; flat in uint v_rapid; out vec4 colour;
void main() {
  bool done = v_time <= u_now;
  vec3 cut = mix(u_deep, u_high, v_share);
  vec3 plain = v_rapid == 1u ? u_rapid : (done ? cut : u_coming);
  colour = vec4(plain, 1.0);
}`;

const UNIFORMS = [
  "u_low", "u_size", "u_seconds", "u_middle", "u_scale", "u_pixel", "u_depth", "u_half", "u_rapids",
  "u_deep", "u_high", "u_coming", "u_rapid", "u_now",
];

/** {draw(scene) -> promise of ms, free()}; null if the browser has no WebGL2. */
export function pathPicture(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, powerPreference: "low-power" });
  if (!gl) return null;
  const program = programOf(gl, VERTEX, FRAGMENT), buffers = new Map();
  const at = Object.fromEntries(UNIFORMS.map((name) => [name, gl.getUniformLocation(program, name)]));
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  for (const place of [0, 1]) {
    gl.enableVertexAttribArray(place);
    gl.vertexAttribDivisor(place, 1);
  }

  /** The buffer of a chunk's points; the least recently used buffers are freed, because a card's memory is limited. */
  function bufferOf(points) {
    const known = buffers.get(points);
    if (known) buffers.delete(points);
    const buffer = known ?? upload(points);
    buffers.set(points, buffer);
    return buffer;
  }
  function upload(points) {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, points, gl.STATIC_DRAW);
    return buffer;
  }
  function spare() {
    let held = 0;
    for (const points of buffers.keys()) held += points.byteLength;
    for (const [points, buffer] of buffers) {
      if (held <= MOST_BYTES) break;
      held -= points.byteLength;
      gl.deleteBuffer(buffer);
      buffers.delete(points);
    }
  }

  /** scene: {camera {x, y, scale}, ratio, now, depth, rapids, colours, chunks: [{row, points}]}. */
  function draw(scene) {
    const began = performance.now(), { camera, ratio, colours, chunks } = scene;
    const pixel = [2 / canvas.width, 2 / canvas.height], scale = camera.scale * ratio;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniform2f(at.u_middle, camera.x, camera.y);
    gl.uniform2f(at.u_scale, scale * pixel[0], scale * pixel[1]);
    gl.uniform2f(at.u_pixel, ...pixel);
    gl.uniform2f(at.u_depth, scene.depth[0], Math.max(scene.depth[1], scene.depth[0] + 1e-6));
    gl.uniform1i(at.u_rapids, scene.rapids ? 1 : 0);
    gl.uniform1f(at.u_now, scene.now);
    for (const name of ["deep", "high", "coming", "rapid"]) gl.uniform3fv(at[`u_${name}`], colours[name]);
    const segments = chunks.reduce((sum, { row }) => sum + row.count - 1, 0);
    const wide = segments <= WIDE_SEGMENTS;
    gl.uniform1f(at.u_half, wide ? 0.6 * ratio : 0);
    for (const { row, points } of chunks) chunk(row, points, wide, scene.now);
    spare();
    return finished(gl, began);
  }
  function chunk(row, points, wide, now) {
    gl.bindBuffer(gl.ARRAY_BUFFER, bufferOf(points));
    gl.vertexAttribIPointer(0, 4, gl.UNSIGNED_SHORT, POINT_BYTES, 0);
    gl.vertexAttribIPointer(1, 4, gl.UNSIGNED_SHORT, POINT_BYTES, POINT_BYTES);
    gl.uniform3fv(at.u_low, row.low);
    gl.uniform3fv(at.u_size, row.high.map((high, k) => high - row.low[k]));
    gl.uniform3f(at.u_seconds, row.t0, row.t1, now);
    gl.drawArraysInstanced(wide ? gl.TRIANGLE_STRIP : gl.LINES, 0, wide ? 4 : 2, row.count - 1);
  }

  return { draw, free: () => release(gl) };
}

/** Resolves with the milliseconds since `began` when the graphics card has drawn everything. */
async function finished(gl, began) {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  while (fence && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((done) => setTimeout(done, 2));
  gl.deleteSync(fence);
  return performance.now() - began;
}
