/**
 * Jogs with a gamepad: its cross in the plane, its right shoulder up, its left one down. While it is watched, pressing one
 * button starts a jog, and any change ends it: another button, releasing it, a disconnected pad.
 */

const DIRECTIONS = new Map([
  [12, [0, 1, 0]],
  [13, [0, -1, 0]],
  [14, [-1, 0, 0]],
  [15, [1, 0, 0]],
  [5, [0, 0, 1]],
  [4, [0, 0, -1]],
]); // by their numbers in the standard layout

/** {on(), off()}. Buttons that are already pressed when it is switched on start nothing. */
export function watchGamepad({ begin, end }) {
  let frame = 0;
  let before = null;
  function look() {
    const pressed = pressedButtons();
    if (before?.length === 0 && pressed.length === 1) begin(DIRECTIONS.get(pressed[0]));
    else if (before?.length && before.join() !== pressed.join()) end();
    before = pressed;
    frame = requestAnimationFrame(look);
  }
  return {
    on: () => !frame && ((before = null), look()),
    off() {
      cancelAnimationFrame(frame);
      frame = 0;
    },
  };
}

function pressedButtons() {
  const pads = [...(navigator.getGamepads?.() ?? [])].filter((pad) => pad?.connected);
  return pads.flatMap((pad) => [...DIRECTIONS.keys()].filter((place) => pad.buttons[place]?.pressed));
}
