/** What a mill does, in words for the person beside it, and what that allows. */

import { t } from "../lib/language.js";
import { hours, jobName, sentence } from "../lib/words.js";
import { depthInBlock } from "./place.js";
import { RUN_STATES, STATES, describe } from "./sentences.js";

const MOVING = new Set(["run", "holding", "jog", "homing"]);
const LIVE = new Set(["running", "holding", "held", "stopping", "recovering"]);
const PASSING = new Set(["stopping", "recovering"]);
const UNANSWERED = new Set(["agent_absent", "agent_unreached"]);

/** An entry of the mill's log in words. */
export function logWords({ kind, words, code, values }) {
  if (kind === "state") return STATES[words]?.[1] ?? words;
  return code ? describe({ code, values, words }).whole : words;
}

/** Why the mill's state is not known, and what restores the connection. */
export function outOfReach({ agent, remote }) {
  const why = describe(agent).whole;
  if (!UNANSWERED.has(agent.code)) return why;
  return `${why} ${remote ? t("Switch it on, or start causticmill mill on it.") : t("To connect it again, start the server again.")}`;
}

/** {brief, whole}: why an order was refused. */
export function refusalOf({ code, values, effect, detail, message }) {
  return describe({ code, values: { ...values, effect: effect || detail }, words: (detail ?? message).trim() });
}

/** The same as one text. */
export function refusal(error) {
  return refusalOf(error).whole;
}

/** {brief, whole}: the mill's own message. */
export function millWords({ connected, code, alarm, detail, problem }) {
  return describe(connected ? { code, values: { alarm }, words: detail } : { words: problem });
}

/** The state of a machine: {kind, word, words}; words has details if there are any. A mill that was only switched on needs no one. */
export function standing(machine) {
  if (machine.problem) return { kind: "bad", word: t("cannot be used"), words: sentence(machine.problem) };
  if (!machine.agent.reachable) return { kind: "bad", word: t("out of reach"), words: outOfReach(machine) };
  const { mill } = machine;
  if (mill.state === "alarm" && !mill.alarm && !machine.run) return { kind: "wait", word: t("not homed yet"), words: millWords(mill).whole };
  const [kind, word] = depthInBlock(machine) && !hasLiveRun(machine) ? ["warn", t("idle, tool in the block")] : doing(mill, machine.run);
  return { kind, word, words: millWords(mill).whole };
}

/** A program with its job: those of two jobs have the same names. */
export function programWords(program, job) {
  return job ? t`${program} of ${jobName({ name: job })}` : program;
}

/** The seconds that a run has left, null if that is not known. A simulated mill may be many times as fast: those of a real one. */
export function secondsLeft({ time_s, time_left_s: left_s, share }, simulated) {
  return simulated && Number.isFinite(left_s) ? time_s * (1 - share) : left_s;
}

/** The same in words; "" if it is not known. */
export function leftWords(run, simulated) {
  const left_s = secondsLeft(run, simulated);
  return Number.isFinite(left_s) ? t`${hours(left_s)} left${simulated ? t(" on a real mill") : ""}` : "";
}

/** The address of a mill's own screen. */
export function addressOf(name) {
  return `#/machines/${encodeURIComponent(name)}`;
}

/** Its state for a person at another screen, including a program that waits on a mill without fault. */
export function standingInShop(machine) {
  const own = standing(machine);
  if (own.kind !== "good" || !machine.run || hasLiveRun(machine)) return own;
  const [kind, word] = RUN_STATES[machine.run.state] ?? ["off", machine.run.state];
  return { ...own, kind, word };
}

const URGENCY = ["off", "good", "wait", "busy", "warn", "bad"];

/** How urgently a mill needs a person, for comparison. */
export function urgency(machine) {
  return URGENCY.indexOf(standingInShop(machine).kind);
}

export function needsHand(machine) {
  return urgency(machine) >= URGENCY.indexOf("warn");
}

/**
 * Mill and program in one word. A controller reports idle until its first move, and while it waits for the next one, so
 * during a program the state of the program counts.
 */
function doing(mill, run) {
  const own = STATES[mill.state] ?? ["off", mill.state];
  if (!LIVE.has(run?.state)) return mill.state === "run" ? ["busy", t("moving")] : own;
  if (mill.state === "idle" && run.state === "running" && !run.executed_line) return ["busy", t("starting")];
  if (mill.state === "idle") return RUN_STATES[run.state];
  return mill.state === "run" && PASSING.has(run.state) ? RUN_STATES[run.state] : own;
}

/** The state of the shown run, in the mill's words while it is on the mill. */
export function runStanding(run, machine) {
  const live = machine?.run?.id === run.id && LIVE.has(run.state) && machine.agent.reachable;
  return live ? doing(machine.mill, machine.run) : (RUN_STATES[run.state] ?? ["off", run.state]);
}

/** Whether the mill is known to hear us. */
export function isConnected(machine) {
  return Boolean(machine?.mill?.connected);
}

/** Whether something moves or may move; an unknown state counts as moving. */
export function mayMove(machine) {
  if (!machine?.mill) return true;
  return MOVING.has(machine.mill.state) || hasLiveRun(machine);
}

/** Whether the mill certainly stands still and will stay there; between two lines of a program it only seems to. */
export function stands({ mill, run }) {
  if (!mill) return false;
  if (["held", "door", "tool", "alarm", "sleep"].includes(mill.state)) return true;
  return !MOVING.has(mill.state) && !LIVE.has(run?.state);
}

export function hasLiveRun(machine) {
  return LIVE.has(machine?.run?.state);
}

/**
 * Why an order that moves the mill cannot be given now, in words; "" if it can.
 * states: in which the mill takes it; besideRun: it takes it while a program is on it, too.
 */
export function whyNot({ machine, away, mine }, states = ["idle"], { besideRun = false } = {}) {
  if (away) return t("The server does not answer.");
  if (!machine) return t("Nothing is known of this mill yet.");
  if (machine.problem || !machine.agent.reachable) return t("The mill is out of reach.");
  if (!machine.mill.connected) return t("The mill is not connected.");
  if (!mine) return machine.control ? t`${machine.control.operator} has control.` : t("Take control first.");
  if (hasLiveRun(machine) && !besideRun) return t("A program is on the mill.");
  if (states.includes(machine.mill.state)) return "";
  if (machine.mill.state === "alarm") return t("The mill is locked: home it, or unlock it.");
  return t`The mill is ${STATES[machine.mill.state]?.[1] ?? machine.mill.state}.`;
}

/** A position as on the readout of a control: fixed places, a true minus sign. */
export function coordinate(value, places = 3) {
  if (!Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(places);
  return value < 0 && Number(text) !== 0 ? `−${text}` : text;
}
