/** What a mill does, in words for the person beside it, and what that allows. */

import { ball, sentence as inWords } from "../lib/words.js";
import { depthInBlock } from "./place.js";

const STATES = {
  disconnected: ["bad", "not connected"],
  connecting: ["busy", "connecting"],
  idle: ["good", "idle"],
  run: ["busy", "running"],
  holding: ["warn", "stopping"],
  held: ["warn", "held"],
  jog: ["busy", "jogging"],
  homing: ["busy", "homing"],
  door: ["warn", "door open"],
  check: ["warn", "check mode, nothing moves"],
  alarm: ["bad", "locked"],
  sleep: ["off", "asleep"],
  tool: ["warn", "waits for a tool change"],
};

const MOVING = new Set(["run", "holding", "jog", "homing"]);
const LIVE = new Set(["running", "holding", "held", "stopping", "recovering"]);
const PASSING = new Set(["stopping", "recovering"]);

const STOPS = { hold: "HOLD", abort: "STOP", "jog-cancel": "End of a jog" };

/** An entry of the mill's log in words. */
export function logWords({ kind, words }) {
  if (kind === "state") return STATES[words]?.[1] ?? words;
  if (kind === "order" && words in STOPS) return STOPS[words];
  return plain(words).replace(/: parked$/, `: ${RUN_WORDS.parked[1]}`);
}

export const RUN_WORDS = {
  preparing: ["busy", "being handed to the mill"],
  refused: ["bad", "refused"],
  lost: ["bad", "lost"],
  parked: ["wait", "waits for your start"],
  running: ["busy", "running"],
  holding: ["warn", "stopping"],
  held: ["warn", "held"],
  stopping: ["warn", "being stopped"],
  interrupted: ["bad", "interrupted"],
  recovering: ["busy", "going back to its place"],
  finished: ["good", "finished"],
  aborted: ["off", "stopped"],
};

// What parts of the service say of each other, and what a person beside the mill has to know of it; in this order.
const BESIDE = "the computer beside the mill";
const PLAIN = [
  [/machine '[^']*' has no agent at present(?:; `serve` starts one)?/g, `${BESIDE} does not answer`],
  [/the agent of '[^']*' cannot be reached: [^;]*/g, `${BESIDE} does not answer`],
  [/machine '[^']*': at \S+ there is (?:no agent|'[^']*')/g, `another program answers in place of ${BESIDE}`],
  [/machine '[^']*': (?=the agent|its agent)/g, ""],
  [/the agent ended while the run was/g, `${BESIDE} stopped while the program was`],
  [/the event stream of (?=the agent|its agent)/g, "the connection to "],
  [/its agent's token/g, `the key of ${BESIDE}`],
  [/(?:the|its) agent(?: of '[^']*')?(?: at \S+)? does not take the token we have for it/g, `${BESIDE} does not take this server's key`],
  [/given up while its agent had it as \w+/g, "given up"],
  [/; start the agent again/g, "; start it again"],
  [/(?:the|its) agent(?: of '[^']*')?|the mill's thread/g, BESIDE],
  [/ of job [0-9a-f-]{36}/g, ""],
  [/\brun \d{8}-\d{6}-\w+/g, "the program"],
  [/ \(trust position\)/g, ""],
  [/^SendBlock: /g, ""],
  [/ is not a plain block\b/g, " is no line of G-code"],
];

/** The server's or the agent's words without those for its own parts, which nobody sees who stands at the mill. */
export function plain(words) {
  return PLAIN.reduce((said, [technical, own]) => said.replace(technical, own), words);
}

/** Why nothing is known of the mill, and what brings it back. */
export function outOfReach({ agent, remote }) {
  const why = sentence(agent.words);
  if (!why.includes("does not answer")) return why;
  return `${why} ${remote ? "Switch it on, or start causticmill mill on it." : "To connect it again, start the server again."}`;
}

// What an order was refused for, by the code of the refusal.
const REFUSALS = {
  grant_expired: "Not carried out: it came to the mill too late. Look at the mill, then press again.",
  grant_stopped: "Not carried out: the mill was told to stop after you pressed. Look at the mill, then press again.",
  grant_lease: "Not carried out: control of the mill has changed since you pressed.",
  grant_unknown: "Not carried out: the mill does not know this order any more. Look at the mill, then press again.",
  plan_changed: "Not carried out: the way to go on has changed since it was shown. Read it again, then tick again.",
  setup_changed: "Not started: zero or position have changed since you looked. Compare the readout with the block, then tick again.",
};

/** What an order was refused for. */
export function refusal(error) {
  return REFUSALS[error.code] ?? sentence((error.detail ?? error.message).trim());
}

/** How a machine stands: {kind, word, words}; words say more where there is more to say. */
export function standing(machine) {
  if (machine.problem) return { kind: "bad", word: "cannot be used", words: machine.problem };
  if (!machine.agent.reachable) return { kind: "bad", word: "out of reach", words: outOfReach(machine) };
  const { mill } = machine;
  const [kind, word] = depthInBlock(machine) && !hasLiveRun(machine) ? ["warn", "idle, tool in the block"] : doing(mill, machine.run);
  return { kind, word, words: mill.connected ? mill.detail : mill.problem };
}

/**
 * Mill and program in one word. The controller calls itself idle until the first move has come to it, and whenever it
 * waits for the next one: while a program is on it, the program says what is going on.
 */
function doing(mill, run) {
  const own = STATES[mill.state] ?? ["off", mill.state];
  if (!LIVE.has(run?.state)) return mill.state === "run" ? ["busy", "moving"] : own;
  if (mill.state === "idle" && run.state === "running" && !run.executed_line) return ["busy", "starting"];
  if (mill.state === "idle") return RUN_WORDS[run.state];
  return mill.state === "run" && PASSING.has(run.state) ? RUN_WORDS[run.state] : own;
}

/** How the run that is shown stands, in the words that its mill has while it is on it. */
export function runStanding(run, machine) {
  const live = machine?.run?.id === run.id && LIVE.has(run.state) && machine.agent.reachable;
  return live ? doing(machine.mill, machine.run) : (RUN_WORDS[run.state] ?? ["off", run.state]);
}

/** Whether the mill is known to hear us. */
export function isConnected(machine) {
  return Boolean(machine?.mill?.connected);
}

/** Whether something moves, or may: what is not known may. */
export function mayMove(machine) {
  if (!machine?.mill) return true;
  return MOVING.has(machine.mill.state) || hasLiveRun(machine);
}

/** Whether the mill is known to stand, and to stay where it is: between two lines of a program it only seems to. */
export function stands({ mill, run }) {
  if (["held", "door", "tool", "alarm", "sleep"].includes(mill.state)) return true;
  return !MOVING.has(mill.state) && !LIVE.has(run?.state);
}

export function hasLiveRun(machine) {
  return LIVE.has(machine?.run?.state);
}

/**
 * Why an order that moves the mill cannot be given now, in words; "" where it can.
 * states: in which the mill takes it; besideRun: it takes it while a program is on it, too.
 */
export function whyNot({ machine, away, mine }, states = ["idle"], { besideRun = false } = {}) {
  if (away) return "The server does not answer.";
  if (!machine) return "Nothing is known of this mill yet.";
  if (machine.problem || !machine.agent.reachable) return "The mill is out of reach.";
  if (!machine.mill.connected) return "The mill is not connected.";
  if (!mine) return machine.control ? `${machine.control.operator} has control.` : "Take control first.";
  if (hasLiveRun(machine) && !besideRun) return "A program is on the mill.";
  if (states.includes(machine.mill.state)) return "";
  if (machine.mill.state === "alarm") return "The mill is locked: home it, or unlock it.";
  return `The mill is ${STATES[machine.mill.state]?.[1] ?? machine.mill.state}.`;
}

/** A position as on the readout of a control: fixed places, a true minus sign. */
export function coordinate(value, places = 3) {
  if (!Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(places);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}

/** What a person looked at before the mill moves; `setup` of the run says what is right. */
export function checkWords(check, run) {
  const { tool, stock, zero, change } = run.setup ?? {};
  switch (check) {
    case "tool":
      return ["The tool is in and tight", [tool && `${tool.shape}, ${ball(tool.radius_mm)}`, change?.words].filter(Boolean).join("; ")];
    case "zero":
      return ["The work zero is set for this tool", zero ?? ""];
    case "stock":
      return ["The block is clamped", stock ? `${stock.width_mm} × ${stock.height_mm} × ${stock.thickness_mm} mm, ${stock.material.toUpperCase()}` : ""];
    case "clear":
      return ["Nothing is in the way of the tool", "hands, clamps, wrenches, the probe's cable; goggles on"];
    case "position":
      return ["The position shown is where the tool really is", "compare the readout with the block"];
    case "order":
      return ["Passes may be left out", `not finished on this mill: ${run.left_out.map((one) => one.name).join(", ")}`];
    default:
      return [check, ""];
  }
}

/** The same as a sentence, without the codes of the controller in them. */
export function sentence(words) {
  if (!words) return "";
  const alarm = plain(words).replaceAll(/\bALARM:\d+ \(((?:[^()]|\([^()]*\))*)\)/g, "$1").replaceAll(/\bALARM:\d+ /g, "");
  return inWords(alarm.replaceAll(/ \(\$\w+\)/g, ""));
}
