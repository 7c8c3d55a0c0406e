/** Mouse, touch, wheel and keys on a drawing, as three movements: drag, zoom about a place, and keys. */

const WHEEL_STEP = 0.0015;
const KEY_STEP = 40;
const KEY_ZOOM = 1.3;

/**
 * on: {drag(dx, dy), zoom(factor, x, y), reset(), start?(), end?()}, in CSS pixels from the element's upper left corner.
 * The wheel zooms only while the element has the focus (a click gives it), so that a page scrolls past it; pinching on
 * a touch pad always zooms.
 */
export function gestures(element, on) {
  const touching = new Map();
  element.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    element.setPointerCapture(event.pointerId);
    touching.set(event.pointerId, place(element, event));
    if (touching.size === 1) on.start?.();
  });
  element.addEventListener("pointermove", (event) => {
    const before = touching.get(event.pointerId);
    if (!before) return;
    const now = place(element, event), other = [...touching].find(([id]) => id !== event.pointerId)?.[1];
    touching.set(event.pointerId, now);
    if (!other) return on.drag(now.x - before.x, now.y - before.y);
    on.drag((now.x - before.x) / 2, (now.y - before.y) / 2);
    on.zoom(distance(now, other) / Math.max(1, distance(before, other)), (now.x + other.x) / 2, (now.y + other.y) / 2);
  });
  for (const name of ["pointerup", "pointercancel"]) {
    element.addEventListener(name, (event) => {
      if (touching.delete(event.pointerId) && touching.size === 0) on.end?.();
    });
  }
  element.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && document.activeElement !== element) return;
    event.preventDefault();
    const { x, y } = place(element, event), lines = event.deltaMode === 1 ? 16 : 1;
    on.zoom(Math.exp(-event.deltaY * lines * WHEEL_STEP * (event.ctrlKey ? 4 : 1)), x, y);
  }, { passive: false });
  element.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !key(event.key, element, on)) return;
    event.preventDefault();
  });
}

function key(name, element, on) {
  const arrows = { ArrowLeft: [KEY_STEP, 0], ArrowRight: [-KEY_STEP, 0], ArrowUp: [0, KEY_STEP], ArrowDown: [0, -KEY_STEP] };
  const middle = [element.clientWidth / 2, element.clientHeight / 2];
  if (name in arrows) on.drag(...arrows[name]);
  else if (name === "+" || name === "=") on.zoom(KEY_ZOOM, ...middle);
  else if (name === "-") on.zoom(1 / KEY_ZOOM, ...middle);
  else if (name === "0" || name === "Home") on.reset();
  else return false;
  return true;
}

function place(element, event) {
  const box = element.getBoundingClientRect();
  return { x: event.clientX - box.left, y: event.clientY - box.top };
}

function distance(a, b) {
  return Math.hypot(a.x - b.x, a.y - b.y);
}
