/** What is wrong, in words, and the one safe thing to do next. */

import { h, replace } from "../lib/dom.js";
import { shape } from "../lib/state.js";
import { RUN_WORDS, sentence } from "./words.js";

/** [kind, what is wrong, what to do next] or null where nothing is. */
export function troubleOf(link) {
  const { machine, run, away, gone } = link;
  if (gone) return ["bad", gone, "Go back to the list of machines."];
  if (away) return ["bad", "The server does not answer. What is shown is what it said last.", "The mill goes on with what it has. To stop it, use the button on the mill. This page goes on by itself when the server is back."];
  if (!machine) return null;
  if (machine.problem) return ["bad", machine.problem, "Correct the file of this machine; this page sees it at once."];
  if (!machine.agent.reachable) return ["bad", sentence(machine.agent.words) || "The mill's agent does not answer.", "Start the server again: it starts the agent. The mill may still be moving: look at it, and use its own button to stop it."];
  return troubleOfMill(machine) ?? troubleOfRun(machine, run);
}

function troubleOfMill({ mill, run }) {
  if (mill.state === "connecting") return ["busy", "Connecting to the mill.", "Wait a few seconds."];
  if (!mill.connected) return unplugged(mill, run);
  switch (mill.state) {
    case "alarm":
      return ["bad", `The mill is locked. ${/^locked/i.test(mill.detail) ? "" : sentence(mill.detail)}`, "Free the tool if it is stuck, then home the mill. Unlock it only if you know where it is."];
    case "door":
      return ["warn", "The safety door is open.", "Close it, then resume; or stop."];
    case "tool":
      return ["warn", "The program waits for a tool change.", "Change the tool, then resume; or stop."];
    case "sleep":
      return ["warn", "The mill is asleep: its motors are off and it may have been moved by hand.", "Reset it, then home it or set the work zero anew."];
    default:
      return null;
  }
}

function unplugged(mill, run) {
  const latched = mill.latched ? ` Your ${mill.latched} is carried out first when it is back.` : "";
  const cut = run && run.state === "interrupted" ? " Its program is interrupted; what was cut is known." : "";
  return [
    "bad",
    `The mill is not connected: is its cable in, and is it switched on? ${sentence(mill.problem)}${cut}`,
    `Look at the mill first: it may still carry out what it holds, and the spindle may turn. Stop it with its own button. Then put the cable back; it is found again by itself, and nothing moves by that.${latched}`,
  ];
}

function troubleOfRun(machine, run) {
  if (!run?.required_checks?.includes("position")) return null;
  const [, word] = RUN_WORDS[run.state] ?? ["", run.state];
  const line = run.executed_line ? ` after line ${run.executed_line.toLocaleString()}` : "";
  return [run.state === "aborted" ? "warn" : "bad", `${run.program.name} was ${word}${line}. ${sentence(run.words)}`, "The part is not lost: go on below, step by step. Nothing moves before you say so."];
}

export function trouble(link) {
  const node = h("div", { class: "trouble", role: "alert" });
  let shown = "";
  return {
    node,
    update() {
      const found = troubleOf(link);
      const now = found ? found.join("\n") : "";
      if (now === shown) return;
      shown = now;
      if (!found) return void replace(node);
      const [kind, wrong, next] = found;
      replace(node, h("div", { class: `notice ${kind}` }, shape(kind), h("div", {}, h("p", {}, wrong), h("p", {}, h("strong", {}, "Next: "), next))));
    },
  };
}
