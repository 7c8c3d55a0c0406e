/**
 * Jogging for as long as something is held down: a finger, a button of the mouse, a key.
 *
 * Each order moves the mill only a little way, so that it stops by itself even if no further order reaches it.
 * Any end of the hold sends a stop at once, and again until the mill is seen to stand still: a stop that overtakes the
 * jog would stop nothing.
 */

const MOST_S = 3; // of one hold
const MOST_MM = 20;
const AGAIN_MS = 250;
const TRIES = 6;
const ENDS = ["pointerup", "pointercancel", "blur", "pagehide"];

/** {begin(direction), end(), close()}. go(by_mm): orders a jog, true if it was taken; feed(): mm/min. */
export function holdToJog(link, { go, feed }) {
  let held = false;
  let asking = false;
  let timer = 0;

  async function begin(direction) {
    if (held || asking) return;
    clearTimeout(timer);
    held = asking = true;
    const far = Math.min(MOST_MM, (feed() / 60) * MOST_S);
    const taken = await go(direction.map((one) => one * far));
    asking = false;
    if (!held) stop(TRIES);
    else if (!taken) held = false;
  }

  function end() {
    if (!held) return;
    held = false;
    stop(TRIES);
  }

  function stop(tries) {
    clearTimeout(timer);
    link.sendUrgent("jog-cancel");
    const again = () => (asking || link.machine?.mill?.state === "jog") && stop(tries - 1);
    if (tries > 1) timer = setTimeout(again, AGAIN_MS);
  }

  /** A jog of a whole step also ends when the page is hidden. */
  function endWhenHidden() {
    if (!document.hidden) return;
    if (held) end();
    else if (link.mine && link.machine?.mill?.state === "jog") stop(TRIES);
  }

  /** The focus moves between controls all the time: only losing the focus of the whole window counts. */
  const endOn = (event) => (event.type !== "blur" || event.target === window) && end();

  for (const kind of ENDS) addEventListener(kind, endOn, { capture: true });
  document.addEventListener("visibilitychange", endWhenHidden);
  return {
    begin,
    end,
    get held() {
      return held;
    },
    close() {
      end();
      for (const kind of ENDS) removeEventListener(kind, endOn, { capture: true });
      document.removeEventListener("visibilitychange", endWhenHidden);
    },
  };
}
