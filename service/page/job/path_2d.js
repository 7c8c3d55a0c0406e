/** Chunks of a tool path as lines on a plain canvas, for browsers without WebGL2. */

/** {draw(scene) -> promise of ms, free()}: the scene of path_gl.js. */
export function plainPathPicture(canvas) {
  const context = canvas.getContext("2d");
  return {
    async draw(scene) {
      const began = performance.now();
      context.clearRect(0, 0, canvas.width, canvas.height);
      context.lineWidth = Math.max(1, scene.ratio);
      for (const kind of ["coming", "cut", "rapid"]) {
        if (kind === "rapid" && !scene.rapids) continue;
        context.strokeStyle = colourOf(scene.colours[kind === "cut" ? "deep" : kind]);
        for (const { row, points } of scene.chunks) strokes(context, canvas, scene, row, points, kind);
      }
      return performance.now() - began;
    },
    free() {},
  };
}

function strokes(context, canvas, { camera, ratio, now }, row, points, kind) {
  if ((kind === "cut" && row.t0 > now) || (kind === "coming" && row.t1 <= now)) return;
  const scale = camera.scale * ratio;
  const place = (k) => [
    canvas.width / 2 + (row.low[0] + (points[4 * k] / 65535) * (row.high[0] - row.low[0]) - camera.x) * scale,
    canvas.height / 2 - (row.low[1] + (points[4 * k + 1] / 65535) * (row.high[1] - row.low[1]) - camera.y) * scale,
  ];
  const upTo = row.t1 > row.t0 ? ((now - row.t0) / (row.t1 - row.t0)) * 16383 : 0;
  let going = false;
  context.beginPath();
  for (let k = 1; k < row.count; k++) {
    const bits = points[4 * k + 3], done = bits >> 2 <= upTo && row.t0 <= now;
    const wanted = kind === "rapid" ? bits & 1 : !(bits & 1) && done === (kind === "cut");
    if (wanted && !(bits & 2)) {
      if (!going) context.moveTo(...place(k - 1));
      context.lineTo(...place(k));
      going = true;
    } else going = false;
  }
  context.stroke();
}

function colourOf(shares) {
  return `rgb(${shares.map((share) => Math.round(share * 255)).join(" ")})`;
}
