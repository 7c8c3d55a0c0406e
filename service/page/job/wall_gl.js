/** The wall with its picture, and the beam from the lens to it: drawn into the scene of the lens. */
import { programOf } from "./gl.js";

const VERTEX = `#version 300 es
uniform mat4 u_view;
layout(location = 0) in vec3 a_point; layout(location = 1) in vec2 a_place;
out vec2 v_place;
void main() {
  v_place = a_place;
  gl_Position = u_view * vec4(a_point, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D u_picture; uniform bool u_beam;
in vec2 v_place; out vec4 colour;
void main() {
  float left = v_place.x; // of the beam's light, which thins out on its way
  colour = u_beam ? vec4(vec3(1.0, 0.93, 0.78) * 0.11 * left, 0.0) : vec4(texture(u_picture, v_place).rgb * vec3(1.0, 0.97, 0.90), 1.0);
}`;

const SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]; // lower left corner first, anticlockwise as seen along -Z

/**
 * Corners (mm) of the wall in the scene: {wide, high, at: [x, y], far}, from `place` {screen, shift, throw_mm}. Light goes
 * away along the scene's Y; X is to the left of the work frame's, whose Y is up.
 */
export function wallCorners({ screen, shift, throw_mm }, middle) {
  return SQUARE.map(([u, v]) => [-(shift[0] + (u - 0.5) * screen.width), throw_mm - middle, shift[1] + (v - 0.5) * screen.height]);
}

/** {draw(view), free()}. `lens`: corners of the lens in the scene, in the same order; viewedFrom: "lens" or "behind". */
export function wallPicture(gl, image, corners, lens, viewedFrom) {
  const program = programOf(gl, VERTEX, FRAGMENT);
  const [view, beam] = ["u_view", "u_beam"].map((name) => gl.getUniformLocation(program, name));
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  const square = [0, 1, 2, 0, 2, 3].flatMap((k) => [...corners[k], viewedFrom === "lens" ? 1 - SQUARE[k][0] : SQUARE[k][0], 1 - SQUARE[k][1]]);
  const sides = SQUARE.flatMap((_, k) => {
    const next = (k + 1) % 4, ring = [lens[k], lens[next], corners[next], lens[k], corners[next], corners[k]];
    return ring.flatMap((point) => [...point, lens.includes(point) ? 1 : 0.25, 0]);
  });
  const made = gl.createVertexArray();
  gl.bindVertexArray(made);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([...square, ...sides]), gl.STATIC_DRAW);
  for (const [at, count, from] of [[0, 3, 0], [1, 2, 12]]) {
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, count, gl.FLOAT, false, 20, from);
  }

  function draw(matrix) {
    gl.useProgram(program);
    gl.uniformMatrix4fv(view, false, matrix);
    gl.bindVertexArray(made);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(beam, 0);
    gl.drawArrays(gl.TRIANGLES, 0, 6);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    gl.uniform1i(beam, 1);
    gl.drawArrays(gl.TRIANGLES, 6, 24);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }
  return {
    draw,
    free() {
      gl.deleteTexture(texture);
      gl.deleteVertexArray(made);
      gl.deleteProgram(program);
    },
  };
}
