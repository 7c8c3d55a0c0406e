/**
 * HOLD and STOP: always in sight, always in the same place (Resume has its own place, empty while nothing is held). Everybody
 * may press them, without control and while other orders are on their way.
 *
 * Keys: while something moves, or a program is held, Space holds, except in a text field and on Resume itself; Escape
 * stops. Shift and R resume: two keys, so that an elbow cannot. A mill that stands still without a program leaves the keys
 * to the controls. A mill in an unknown state is treated as moving.
 */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { refusalLine } from "./order_controls.js";
import { hasLiveRun, isConnected, mayMove, whyNot } from "./words.js";

const HELD = ["held", "door", "tool"];
const WRITING = "input:not([type=checkbox], [type=radio], [type=button]), textarea, select";

export function stops(link) {
  const words = refusalLine();
  const hold = bigButton("hold", t("HOLD"), ["Space", t("Space")], () => link.sendUrgent("hold"));
  const stop = bigButton("stop", t("STOP"), ["Escape", t("Escape")], () => link.sendUrgent("abort"));
  const goOn = () => words.run(() => resumeMill(link));
  const resume = bigButton("primary", t("Resume"), ["Shift+R", t("Shift+R")], goOn);
  const alarm = h("p", { class: "arrived", role: "alert" });
  const node = h("div", { class: "stops", role: "group", "aria-label": t("Stop the mill") }, alarm, words.node, h("div", { class: "stop-row" }, hold, stop, h("div", { class: "resume-place" }, resume)));
  const keys = (event) => onKey(event, link, { resume, goOn });
  addEventListener("keydown", keys, { capture: true });
  return {
    node,
    update() {
      const state = link.machine?.mill?.state;
      const why = whyNot(link, HELD, { besideRun: true });
      hold.classList.toggle("taken", !link.away && isConnected(link.machine) && HELD.includes(state));
      resume.hidden = !HELD.includes(state);
      resume.disabled = link.busy || why !== "";
      write(alarm, link.stopper.words || outageWords(link));
    },
    close: () => removeEventListener("keydown", keys, { capture: true }),
  };
}

/** Why HOLD and STOP may not reach the mill; "" if they do. */
function outageWords({ away, machine }) {
  if (away) return t("The server does not answer. To stop, use the button on the mill itself.");
  return machine && !isConnected(machine) ? t("This page cannot reach the mill. To stop, use the button on the mill itself.") : "";
}

function bigButton(kind, label, [key, keyWords], act) {
  return h("button", { type: "button", class: `big ${kind}`, "aria-keyshortcuts": key, onclick: act }, h("span", {}, label), h("kbd", {}, keyWords));
}

function resumeMill(link) {
  return hasLiveRun(link.machine) ? link.toRun("resume") : link.order("resume");
}

function onKey(event, link, { resume, goOn }) {
  if (event.repeat || event.ctrlKey || event.altKey || event.metaKey || !mayMove(link.machine)) return;
  const writing = event.target.closest?.(WRITING);
  if (event.key === "Escape") {
    link.sendUrgent("abort");
  } else if (event.key === "R" && event.shiftKey && !writing) {
    if (!resume.hidden && !resume.disabled) goOn();
  } else if (event.key === " " && !writing && event.target !== resume) {
    link.sendUrgent("hold");
    event.preventDefault();
  }
}
