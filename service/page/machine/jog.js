/**
 * Jogging: one press is one step, never more, and steps add up; or, if a person has chosen that, the mill moves as long
 * as a button is pressed. Keyboard and gamepad jog only while they are armed, and they are armed only as long as the
 * focus stays in the pad; a key that is held down does nothing further. A tool in the block may only go up, unless a
 * person has allowed more.
 */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { watchGamepad } from "./gamepad.js";
import { holdToJog } from "./held.js";
import { depthInBlock, withinTravel } from "./place.js";
import { enable, refusalLine } from "./order_controls.js";
import { WaitingSteps } from "./waiting_steps.js";
import { isConnected, whyNot } from "./words.js";

const STEPS_MM = [0.01, 0.1, 1, 10, 50, 100];
const MOST_Z_MM = 10;
const FEED_MM_PER_MIN = 1000;
const HELD = t("while pressed");
const KEYS = {
  ArrowRight: [1, 0, 0],
  ArrowLeft: [-1, 0, 0],
  ArrowUp: [0, 1, 0],
  ArrowDown: [0, -1, 0],
  PageUp: [0, 0, 1],
  PageDown: [0, 0, -1],
};
/** [place in the grid, label, arrow, direction] */
const PAD = [
  ["y-plus", t("Y plus"), "↑ Y", [0, 1, 0]],
  ["x-minus", t("X minus"), "← X", [-1, 0, 0]],
  ["x-plus", t("X plus"), "X →", [1, 0, 0]],
  ["y-minus", t("Y minus"), "↓ Y", [0, -1, 0]],
  ["z-plus", t("Z up"), "↑ Z", [0, 0, 1]],
  ["z-minus", t("Z down"), "↓ Z", [0, 0, -1]],
];
const UP = 4; // place in PAD

export function jogPanel(link) {
  const words = refusalLine();
  const steps = stepChoice(() => showStep());
  const feed = h("input", { type: "number", min: 1, max: 20000, step: 1, value: 500, inputMode: "numeric" });
  const inside = allowInBlock(() => link.changed());
  const go = (by_mm, feed_mm_per_min, given) => words.run(() => link.order("jog", { by_mm: limitStep(link, inside, by_mm), feed_mm_per_min }, given));
  const waits = h("p", { class: "waits dim", role: "status" });
  const showWaiting = () => write(waits, waiting.words ? t`Waiting: ${waiting.words}` : waiting.dropped);
  const waiting = new WaitingSteps(link, { send: go, changed: showWaiting });
  const hold = holdToJog(link, { go: (by_mm) => go(by_mm, feed.valueAsNumber), feed: () => feed.valueAsNumber });
  const lengthOf = (direction) => direction.map((one, k) => one * Math.min(steps.mm(), k === 2 ? MOST_Z_MM : Infinity));
  const step = (direction) => !steps.held() && words.run(() => waiting.press(lengthOf(direction), feed.valueAsNumber));
  const begin = (direction) => (steps.held() ? hold.begin(direction) : step(direction));
  const press = (event, direction) => event.button === 0 && steps.held() && hold.begin(direction);
  const buttons = PAD.map(([place, label, arrow, direction]) =>
    h("button", {
      type: "button", class: `big ${place}`, "aria-label": label,
      onclick: () => step(direction), onpointerdown: (event) => press(event, direction),
      oncontextmenu: (event) => steps.held() && event.preventDefault(), // a long touch would open it
    }, arrow, direction[2] !== 0 && h("small", {})),
  );
  const cancel = h("button", { type: "button", class: "cancel", onclick: () => link.sendUrgent("jog-cancel") }, t("End jog"));
  const arm = armKeys({ begin, end: hold.end });
  const pad = h("div", { class: "pad", role: "group", "aria-label": t("Jog") }, buttons, cancel);
  const showStep = () => {
    pad.style.setProperty("touch-action", steps.held() ? "none" : "manipulation");
    const shorter = !steps.held() && steps.mm() > MOST_Z_MM;
    for (const button of buttons.slice(4)) write(button.lastChild, shorter ? `${MOST_Z_MM} mm` : "");
  };
  const node = h(
    "section",
    { class: "card jog", "aria-labelledby": "jog-title" },
    h(
      "div",
      { class: "jog-keys", onkeydown: arm.onKey, onkeyup: arm.onKeyUp, onfocusout: (event) => arm.onFocusOut(event) },
      h("div", { class: "row spread" }, h("h2", { id: "jog-title" }, t("Jog")), arm.node),
      pad,
    ),
    steps.node,
    h("div", { class: "jog-more" }, h("label", { class: "field" }, h("span", {}, t("Feed")), h("span", { class: "with-unit" }, feed, h("span", {}, "mm/min"))), inside.node),
    h("div", { class: "jog-words" }, waits, words.node),
  );
  let fitted = false;
  return {
    node,
    update() {
      waiting.update();
      const why = whyNot(link);
      const able = why === "" && !link.busy;
      const heard = !link.away && isConnected(link.machine);
      inside.update(depthInBlock(link.machine) > 0, link.machine?.mill?.state === "idle");
      enable([...steps.inputs, feed], heard);
      enable([inside.node], heard && link.mine);
      // A step takes a moment; buttons that flicker off and on lose the finger.
      if (able || !isStep(link)) {
        enable([buttons[UP]], able);
        enable(buttons.toSpliced(UP, 1), able && !inside.barred());
      }
      enable([arm.button], why === "" || isStep(link));
      if (why && !isStep(link)) {
        arm.off();
        hold.end();
      }
      cancel.disabled = link.machine?.mill?.state !== "jog";
      if (!fitted && link.machine?.profile) fitted = fit(feed, link.machine.profile);
    },
    close() {
      arm.off();
      hold.close();
    },
  };
}

/** The step, shortened to what is allowed; Error if it is not allowed at all. */
function limitStep({ machine }, inside, by_mm) {
  if ((by_mm[0] || by_mm[1] || by_mm[2] < 0) && inside.barred()) throw new Error(t("The tool stands in the block: raise Z first."));
  const found = withinTravel(machine, by_mm);
  if (!found.some(Boolean)) throw new Error(t("The travel ends here: take a step of 10 mm or less."));
  return found;
}

/** A switch that allows a tool in the block to go anywhere, until it is out; its space is always reserved. */
function allowInBlock(changed) {
  const button = h("button", { type: "button", class: "inside", "aria-pressed": "false", onclick: () => (set(!isOn()), changed()) }, t("Jog in the block"));
  const isOn = () => button.getAttribute("aria-pressed") === "true";
  const set = (on) => button.setAttribute("aria-pressed", String(on));
  let inBlock = false;
  return {
    node: button,
    barred: () => inBlock && !isOn(),
    /** known: the mill stands still, so its position is known. */
    update(now, known) {
      if (known) inBlock = now;
      if (!inBlock) set(false);
      button.style.setProperty("visibility", inBlock ? "visible" : "hidden");
    },
  };
}

/** Whether nothing prevents a jog but a step or an order under way. */
function isStep(link) {
  if (link.machine?.mill?.state !== "jog" && !link.busy) return false;
  return whyNot(link, ["idle", "jog"]) === "";
}

function fit(feed, profile) {
  const fastest = Math.min(...(profile.max_rate_mm_per_min ?? [500]));
  feed.max = Math.round(Math.max(...(profile.max_rate_mm_per_min ?? [20000])));
  feed.value = Math.round(Math.min(FEED_MM_PER_MIN, fastest));
  return true;
}

/** {node, inputs, mm(), held()}: how far one press goes, or "as long as it lasts". */
function stepChoice(changed) {
  const choice = (value) => h("input", { type: "radio", name: "jog-step", value, checked: value === "1", onchange: changed });
  const inputs = [...STEPS_MM.map(String), HELD].map(choice);
  const labels = inputs.map((input) => h("label", {}, input, input.value));
  const node = h("fieldset", { class: "steps" }, h("legend", {}, t("Step, mm")), h("div", { class: "choice" }, labels));
  const chosen = () => inputs.find((input) => input.checked).value;
  return { node, inputs, mm: () => Number(chosen()), held: () => chosen() === HELD };
}

/** Arrow keys and gamepad, once a person has armed them. */
function armKeys({ begin, end }) {
  const words = h("span", {});
  const button = h("button", { type: "button", class: "arm", "aria-pressed": "false", onclick: () => set(!isOn()) }, words);
  const gamepad = watchGamepad({ begin, end });
  const isOn = () => button.getAttribute("aria-pressed") === "true";
  const set = (on) => {
    button.setAttribute("aria-pressed", String(on));
    write(words, on ? t("Keys and gamepad move the mill: arrows, Page Up, Page Down") : t("Use keyboard or gamepad"));
    if (on) gamepad.on();
    else gamepad.off();
  };
  set(false);
  return {
    node: button,
    button,
    off: () => isOn() && set(false),
    onFocusOut(event) {
      if (event.currentTarget.contains(event.relatedTarget)) return;
      set(false);
      end();
    },
    onKey(event) {
      const direction = KEYS[event.key];
      if (!direction || !isOn()) return;
      event.preventDefault();
      if (!event.repeat) begin(direction);
    },
    onKeyUp: (event) => event.key in KEYS && end(),
  };
}
