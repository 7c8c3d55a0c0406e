/** One machine: where it is, what it does, and everything one tells it. */

import { h, replace, sheet, write } from "../lib/dom.js";
import { mark } from "../lib/state.js";
import { terminal } from "./console.js";
import { controlBar } from "./control_bar.js";
import { jog } from "./jog.js";
import { loading } from "./loading.js";
import { MillLink } from "./mill_link.js";
import { overrides } from "./overrides.js";
import { part } from "./part.js";
import { readout } from "./readout.js";
import { recover } from "./recover.js";
import { running } from "./running.js";
import { setup } from "./setup.js";
import { stops } from "./stops.js";
import { trouble } from "./trouble.js";
import { hasLiveRun, standing } from "./words.js";

export default async function view(root, params, app) {
  await sheet("/page/machine/machine.css");
  app.title(params.name);
  const link = new MillLink(params.name);
  const chosen = { job: params.job, program: params.program };
  const load = loading(link, chosen);
  const next = (run) => {
    Object.assign(chosen, { job: run.job, program: run.next.name });
    load.again();
    load.node.scrollIntoView({ block: "center" });
  };
  const program = running(link, { onNext: next });
  const own = { head: head(link), control: controlBar(link), trouble: trouble(link), readout: readout(link), jog: jog(link), setup: setup(link) };
  const others = { program, load, recover: recover(link), part: part(link), overrides: overrides(link), terminal: terminal(link), stops: stops(link) };
  const parts = { ...own, ...others };
  replace(root, layout(parts));
  let wasOpen = false;
  link.onChange(() => {
    const open = Boolean(link.machine?.run);
    if (wasOpen && !open) load.again();
    wasOpen = open;
    for (const one of Object.values(parts)) one.update();
    arrange(link, parts);
  });
  link.changed();
  return {
    leave() {
      link.close();
      for (const one of Object.values(parts)) one.close?.();
    },
  };
}

function layout({ head, control, trouble, readout, jog, setup, program, load, recover, part, overrides, terminal, stops }) {
  const node = (one) => one.node;
  return h(
    "div",
    { class: "machine" },
    h("div", { class: "machine-head" }, head.node, control.node),
    trouble.node,
    h(
      "div",
      { class: "machine-columns" },
      h("div", { class: "stack tool" }, [readout, jog].map(node)),
      h("div", { class: "stack work" }, [recover, program, load, overrides].map(node)),
      h("div", { class: "stack beside" }, [setup, part, terminal].map(node)),
    ),
    stops.node,
  );
}

/** What is of no use now is not shown: while a program is on the mill nobody jogs, and nothing else can be loaded. */
function arrange({ machine }, { jog, setup, load, overrides }) {
  const live = hasLiveRun(machine);
  jog.node.hidden = live;
  setup.node.hidden = live;
  overrides.node.hidden = !live;
  load.node.hidden = Boolean(machine?.run);
}

function head(link) {
  const state = h("p", { class: "machine-state", role: "status" });
  const about = h("p", { class: "dim" });
  const simulated = h("p", { class: "simulated", hidden: true }, mark("warn", "Simulated: no real mill moves"));
  let shown = "";
  return {
    node: h("div", {}, h("h1", {}, link.name), state, simulated, about),
    update() {
      const { machine, away } = link;
      const now = machine ? standing(machine) : { kind: "wait", word: "asking the server", words: "" };
      const word = away ? { kind: "off", word: `last seen ${now.word}`, words: "" } : now;
      if (`${word.kind} ${word.word}` !== shown) replace(state, mark(word.kind, word.word));
      shown = `${word.kind} ${word.word}`;
      simulated.hidden = !machine?.simulated;
      write(about, [!machine?.simulated && machine?.profile?.description, machine?.mill?.controller].filter(Boolean).join(", "));
    },
  };
}
