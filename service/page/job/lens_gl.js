/** The lens as a body of clear acrylic, drawn by WebGL2. No events, no clock: its appearance from one direction. */
import { programOf, release } from "./gl.js";
import { extremes, triangles, vertices, walls } from "./surface.js";
import { wallCorners, wallPicture } from "./wall_gl.js";

const VERTEX = `#version 300 es
uniform mat4 u_view; uniform float u_middle; uniform bool u_upright;
layout(location = 0) in vec3 a_point; layout(location = 1) in vec2 a_slope;
out vec3 v_point; out vec2 v_slope;
void main() {
  v_point = vec3(a_point.xy, a_point.z - u_middle);
  v_slope = a_slope;
  gl_Position = u_view * vec4(u_upright ? vec3(-v_point.x, v_point.z, v_point.y) : v_point, 1.0);
}`;

/**
 * Clear glass, as light added to a dark room: the Fresnel reflection of a window and a floor lamp, the lamp's glint,
 * and the light of the room that the surface bends towards the eye. Nothing is hidden behind it.
 */
const FRAGMENT = `#version 300 es
precision highp float;
uniform vec3 u_eye; uniform bool u_wall;
in vec3 v_point; in vec2 v_slope; out vec4 colour;
vec3 room(vec3 way) { // a dark room: a window, a floor lamp, a pale floor
  float window = smoothstep(0.25, 0.55, dot(way, normalize(vec3(-0.6, -0.35, 0.72))));
  float lamp = smoothstep(0.80, 0.97, dot(way, normalize(vec3(0.8, 0.45, 0.4))));
  return vec3(0.025) + window * vec3(0.80, 0.83, 0.85) + lamp * vec3(1.0, 0.90, 0.72) + max(-way.z, 0.0) * vec3(0.05);
}
void main() {
  vec3 normal = u_wall ? normalize(cross(dFdx(v_point), dFdy(v_point))) : normalize(vec3(-v_slope, 1.0));
  vec3 to_eye = normalize(u_eye - v_point);
  if (dot(normal, to_eye) < 0.0) normal = -normal;
  float facing = dot(normal, to_eye), fresnel = 0.04 + 0.96 * pow(1.0 - facing, 5.0);
  vec3 through = room(refract(-to_eye, normal, 1.0 / 1.49));
  float bends = u_wall ? 0.0 : length(fwidth(v_slope)) / max(length(fwidth(v_point.xy)), 1e-6); // per mm: where light is gathered or spread
  float shine = u_wall ? 0.07 + 0.30 * pow(1.0 - facing, 3.0) : 0.6 * clamp(2.5 * bends, 0.0, 0.6);
  vec3 light = fresnel * room(reflect(-to_eye, normal)) + 0.08 * through + shine * vec3(0.97, 1.0, 0.98);
  colour = vec4(light, 0.5 * clamp(max(light.r, max(light.g, light.b)), 0.0, 1.0));
}`;

/**
 * A picture of the lens on this canvas: {draw(look), showWall(image, place), free()}; null if the browser has no WebGL2.
 * With look.wall the block stands upright, its light goes away from the viewer, and the wall shows its picture.
 */
export function lensPicture(canvas, grid) {
  const gl = canvas.getContext("webgl2", { antialias: true, alpha: true, powerPreference: "low-power" });
  if (!gl) return null;
  const program = programOf(gl, VERTEX, FRAGMENT);
  const { low, high } = extremes(grid);
  const size = Math.hypot((grid.nx - 1) * grid.dx, (grid.ny - 1) * grid.dy);
  const relief = Math.max(high - low, 1e-6);
  const corners = triangles(grid.nx, grid.ny), block = walls(grid, low - Math.max(relief * 0.5, size * 0.04));
  const back = floorOf(block);
  const surface = array(gl, vertices(grid), 5), sides = array(gl, new Float32Array([...block, ...back]), 3);
  gl.bindVertexArray(surface);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
  const at = (name) => gl.getUniformLocation(program, name);
  const [view, eye, wall] = ["u_view", "u_eye", "u_wall"].map(at);
  const [middle, upright] = ["u_middle", "u_upright"].map(at);
  let scene = null;
  gl.enable(gl.DEPTH_TEST);

  function showWall(image, place) {
    scene?.wall.free();
    const [x, y] = [(grid.nx - 1) * grid.dx / 2, (grid.ny - 1) * grid.dy / 2], half = place.throw_mm / 2;
    const lens = [[x, -half, -y], [-x, -half, -y], [-x, -half, y], [x, -half, y]];
    const corners = wallCorners(place, half), far = corners.map((corner) => 2 * Math.hypot(corner[0], corner[2]));
    scene = { wall: wallPicture(gl, image, corners, lens, place.viewedFrom), middle: half, size: Math.hypot(Math.max(size, ...far), place.throw_mm) };
  }

  function draw(look) {
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const shown = look.wall ? scene : null, whole = shown?.size ?? size;
    const from = eyeOf(look, whole), matrix = viewOf(from, canvas.width / canvas.height, whole);
    shown?.wall.draw(matrix);
    gl.useProgram(program);
    gl.uniformMatrix4fv(view, false, matrix);
    gl.uniform3fv(eye, shown ? [-from[0], from[2], from[1]] : from);
    gl.uniform1f(middle, shown?.middle ?? (low + high) / 2);
    gl.uniform1i(upright, shown ? 1 : 0);
    gl.enable(gl.BLEND); // each side of the block adds its light to the light behind it
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    gl.bindVertexArray(sides);
    gl.uniform1i(wall, 1);
    gl.drawArrays(gl.TRIANGLES, 0, (block.length + back.length) / 3);
    gl.bindVertexArray(surface);
    gl.uniform1i(wall, 0);
    gl.drawElements(gl.TRIANGLES, corners.length, gl.UNSIGNED_INT, 0);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  return { draw, showWall, free: () => release(gl) };
}

/** The block's flat back, at the height of the lowest of its walls' points. */
function floorOf(block) {
  const ends = [0, 1].map((axis) => block.filter((_, k) => k % 3 === axis)).map((all) => [all.reduce((a, b) => Math.min(a, b)), all.reduce((a, b) => Math.max(a, b))]);
  const [[left, right], [front, rear]] = ends, z = block[2];
  return [left, front, z, right, front, z, right, rear, z, left, front, z, right, rear, z, left, rear, z];
}

/** Vertices of `floats` floats each: a point and, if there are 5, its slope after it. */
function array(gl, data, floats) {
  const made = gl.createVertexArray();
  gl.bindVertexArray(made);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 4 * floats, 0);
  if (floats === 5) {
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
  }
  return made;
}

/** Where the eye is: turned about Z by `yaw`, lifted by `pitch`, at `distance` times the lens's diagonal. */
function eyeOf({ yaw, pitch, distance }, size) {
  const r = distance * size;
  return [r * Math.cos(pitch) * Math.sin(yaw), -r * Math.cos(pitch) * Math.cos(yaw), r * Math.sin(pitch)];
}

/** Column-major matrix: from `eye` to the middle, Z up, 30 degrees of view at the narrower side. */
function viewOf(eye, aspect, size) {
  const length = Math.hypot(...eye), back = eye.map((each) => each / length);
  const side = Math.hypot(back[0], back[1]) || 1, right = [-back[1] / side, back[0] / side, 0];
  const up = [
    back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
    back[0] * right[1] - back[1] * right[0],
  ];
  const near = Math.max(length - size, 0.02 * size), far = length + size;
  const f = 1 / Math.tan(Math.PI / 12) * Math.min(1, aspect), depth = near - far;
  const rows = [
    right.map((each) => (each * f) / aspect), up.map((each) => each * f),
    back.map((each) => (each * (near + far)) / depth), back.map((each) => -each),
  ];
  const last = [0, 0, (2 * near * far - length * (near + far)) / depth, length];
  const matrix = new Float32Array(16);
  rows.forEach((row, k) => [...row, last[k]].forEach((value, column) => (matrix[column * 4 + k] = value)));
  return matrix;
}
