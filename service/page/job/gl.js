/** Helpers of both WebGL2 pictures. */

/** A program of two shaders; an Error with the compiler's message if they do not link. */
export function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (gl.isContextLost()) return program;
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "no program");
  return program;
}

/** Gives a canvas's memory back now instead of when it is collected: browsers allow some sixteen at a time. */
export function release(gl) {
  gl.getExtension("WEBGL_lose_context")?.loseContext();
}
