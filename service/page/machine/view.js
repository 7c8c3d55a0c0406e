/** One machine: its position, its work, and all orders to it. */

import { h, replace, sheet, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mark } from "../lib/state.js";
import { camera } from "./camera.js";
import { terminal } from "./console.js";
import { controlBar } from "./control_bar.js";
import { history } from "./history.js";
import { jogPanel } from "./jog.js";
import { findNextStep } from "./next_step.js";
import { loadCard } from "./loading.js";
import { MillLink } from "./mill_link.js";
import { next } from "./next.js";
import { ordersGiven } from "./orders_given.js";
import { overrides } from "./overrides.js";
import { part } from "./part.js";
import { readout } from "./readout.js";
import { recover } from "./recover.js";
import { runCard } from "./running.js";
import { setup } from "./setup.js";
import { stops } from "./stops.js";
import { timelapse } from "./timelapse.js";
import { hasLiveRun, standing } from "./words.js";
import { zeroDrawing } from "./zero_drawing.js";

const REST_MS = 1000; // time for which moved controls ignore presses: the press was meant for the control that was there before

export default async function view(root, params, app) {
  await sheet("/page/machine/machine.css");
  app.title(params.name);
  const link = new MillLink(params.name);
  const parts = makeParts(link, { job: params.job, program: params.program });
  const screen = layout(parts);
  replace(root, screen);
  const turned = turning(screen);
  link.onChange(() => {
    parts.load.follow();
    const nextStep = findNextStep(link, { load: parts.load.facts, ticked: parts.program.ticked, named: parts.program.named, byHand: parts.program.byHand });
    for (const one of Object.values(parts)) one.update(nextStep); // the line last: it presses buttons of the cards
    arrange(link, parts);
    turned(link);
  });
  link.changed();
  return {
    leave() {
      link.close();
      for (const one of Object.values(parts)) one.close?.();
    },
  };
}

function makeParts(link, chosen) {
  const own = { head: head(link), control: controlBar(link), readout: readout(link), jog: jogPanel(link), setup: setup(link), zero: zeroDrawing(link) };
  const load = loadCard(link, chosen);
  const others = { program: runCard(link), load, recover: recover(link), part: part(link), overrides: overrides(link), seen: camera(link), film: timelapse(link), terminal: terminal(link), given: ordersGiven(link), past: history(link), stops: stops(link) };
  const cards = { get jog() { return own.jog.node.closest(".tool"); }, load: load.node, program: others.program.node, recover: others.recover.node };
  return { ...own, ...others, next: next(link, cards, { load: () => load.button, start: () => others.program.button }) };
}

/** On a narrow screen the cards of the run come before those of the set-up; `arrange` decides when. */
function layout({ head, control, next, readout, jog, setup, zero, program, load, recover, part, overrides, seen, film, terminal, given, past, stops }) {
  const node = (one) => one.node;
  const stack = (name, ...parts) => h("div", { class: `stack ${name}` }, parts.map(node));
  return h(
    "div",
    { class: "machine" },
    h("div", { class: "machine-head" }, head.node, control.node),
    next.node,
    readout.node,
    h(
      "div",
      { class: "machine-columns" },
      h("div", { class: "left" }, stack("tool", jog), stack("zero", setup, zero)),
      h("div", { class: "right" }, stack("work", recover, program, seen, part, overrides, load), stack("beside", terminal, film, given, past)),
    ),
    stops.node,
  );
}

/** Hide useless cards: while a program is on the mill, jogging and loading another one are not possible. */
function arrange({ machine, run }, { jog, setup, load, overrides, recover }) {
  const live = hasLiveRun(machine);
  jog.node.hidden = live;
  setup.node.hidden = live;
  overrides.node.hidden = !live;
  load.node.hidden = Boolean(machine?.run);
  const workFirst = Boolean(machine?.run) || !recover.node.hidden || run?.state === "finished";
  const columns = jog.node.closest(".machine-columns");
  columns.classList.toggle("work-first", workFirst);
  columns.classList.toggle("live", live);
}

/**
 * When a run begins or ends the screen is another one: it is shown from its top, and for a moment nothing on it but HOLD
 * and STOP can be pressed. The answer to an order may come before or after the mill's report.
 */
function turning(screen) {
  let before = "";
  let timer = 0;
  return ({ machine, run }) => {
    const now = !machine ? "" : hasLiveRun(machine) ? "live" : hasLiveRun({ run }) ? "turning" : "still";
    if (before && now !== before) {
      scrollTo({ top: 0, behavior: "instant" });
      screen.classList.add("resting");
      clearTimeout(timer);
      timer = setTimeout(() => screen.classList.remove("resting"), REST_MS);
    }
    before = now;
  };
}

function head(link) {
  const state = h("p", { class: "machine-state", role: "status" });
  const about = h("p", { class: "dim" });
  const simulated = h("p", { class: "simulated", hidden: true }, mark("warn", t("Simulated: no real mill moves")));
  let shown = "";
  return {
    node: h("div", {}, h("div", { class: "machine-title" }, h("h1", {}, link.name), state), h("div", { class: "machine-about" }, simulated, about)),
    update() {
      const { machine, away } = link;
      const now = machine ? standing(machine) : { kind: "wait", word: t("asking the server"), words: "" };
      const word = away ? { kind: "off", word: t`last seen ${now.word}`, words: "" } : now;
      if (`${word.kind} ${word.word}` !== shown) replace(state, mark(word.kind, word.word));
      shown = `${word.kind} ${word.word}`;
      simulated.hidden = !machine?.simulated;
      if (machine?.profile) write(about, machine.simulated ? "" : machine.profile.description);
    },
  };
}
