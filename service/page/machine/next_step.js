/**
 * The one thing to do next: connect, control, home, load, tool over the zero, zero, tick, start; or, before all that,
 * what is wrong. Pure: it decides, `next.js` shows it, and its button is the only blue one of the page.
 */

import { t } from "../lib/language.js";
import { isCut, isDry } from "../lib/state.js";
import { ball, capital, jobName, sentence, thousands } from "../lib/words.js";
import { depthInBlock, findForeignAxes, isAtHome, isPlaced, isZeroSet, riseToSafe, isZeroKnown } from "./place.js";
import { hasLiveRun, millWords, outOfReach, programWords } from "./words.js";
import { orderWord, RUN_STATES, describe } from "./sentences.js";

const HOME = { label: t("Home"), what: "home", body: {} };
const ZERO_XY = { label: t("X and Y = 0 here"), what: "zero", body: { axes: "XY" } };
const ZERO_Z = { label: t("Z = 0 here"), what: "zero", body: { axes: "Z" } };
const LOAD = { label: t("Load"), press: "load" };
const START = { label: t("Start"), press: "start" };
const OFF = { label: t("Spindle off"), what: "spindle", body: { on: false } };
const RESUME = t("Resume when all is clear, or STOP.");
const RAISE = t("raise Z first.");
const IN_DOUBT = t("From this zero the program may not fit the travel: set the zero where it does.");
const IN_DOUBT_TICKED = { false: t("From this zero the program may not fit the travel: set another zero, or start it."), true: t("At this height it may not fit the travel: load it lower, or start the dry pass.") };
const RAISE_MM_PER_MIN = 500;
const [CLEAR_MM, UP_MM] = [1, 5]; // height over the block from which a program may start; one press raises the tool so far
const NAME = 28; // letters of a job's name

/**
 * {step, kind, words, trouble, act, go, bars}: words of the step; trouble: what is wrong, where something is; act:
 * the order of its button, or `press`: the button of the card that it presses; other: the other answer if it is a question; go: the card for the step; bars: why no program may start or go on before it is done,
 * "" if one may. load: the `facts` of the card "Load a program", ticked: all of the list, named: by whom, byHand: a hand finishes the milled lens.
 */
export function findNextStep(link, { load = {}, ticked = false, named = true, byHand = false } = {}) {
  const trouble = troubleOf(link);
  const standsStill = trouble && !["home", "recover"].includes(trouble.step);
  if (!link.machine && !trouble) return makeStep("wait", t("Asking the server."), { whole: true });
  if (standsStill) return { ...makeStep("trouble", trouble.next, { kind: trouble.kind }), trouble };
  if (hasLiveRun(link.machine)) return findRunningStep(link);
  if (!link.mine) return { ...findControlStep(link), ...(trouble && { kind: trouble.kind }), trouble };
  return { ...findStandingStep(link, trouble, load, { ticked, named, byHand }), trouble };
}

function makeStep(step, words, more = {}) {
  return { step, words, kind: "", trouble: null, act: null, other: null, go: "", bars: "", ...more };
}

function findRunningStep({ machine: { mill, run }, mine }) {
  const resume = mine ? RESUME : t("take control, then Resume; or STOP.");
  if (mill.state === "held") return makeStep("resume", resume, { kind: "warn" });
  if (run.state === "running") return makeStep("run", isDry(run) ? t("The dry pass runs: nothing is cut.") : t("The program runs."), { kind: "busy", whole: true });
  return makeStep("run", t("wait until it stands still."), { kind: "busy" });
}

function findControlStep({ machine: { control } }) {
  if (control) return makeStep("other", t`${control.operator} has control; you are watching.`, { kind: "off", whole: true });
  return makeStep("control", t("take control of the mill."));
}

function findStandingStep(link, trouble, load, given) {
  const { machine, run } = link;
  const { mill } = machine;
  if (mill.state === "homing") return makeStep("wait", t("wait until it is home."), { kind: "busy" });
  if (mill.state === "held") return makeStep("resume", RESUME, { kind: "warn" });
  if (mill.state === "check") return makeStep("check", t("end the check mode (line $C), then go on."), { kind: "warn" });
  if (trouble?.step === "home") return makeStep("home", trouble.next, { kind: trouble.kind, act: HOME });
  const first = findRaiseStep(link, trouble) ?? findHomeStep(machine);
  if (first) return first;
  if (trouble && mill.state === "jog") return makeStep("wait", t("wait until it stands still."), { kind: trouble.kind });
  if (trouble) return makeStep("recover", trouble.next, { kind: trouble.kind, go: "recover" });
  return findSetupStep(link, load, given);
}

/** After a stop the tool is still in the block: it must go up before it goes sideways. */
function findRaiseStep({ machine, run }, trouble) {
  const depth = depthInBlock(machine);
  const low = trouble?.step === "recover" && machine.mill.state === "idle" && isZeroKnown(machine, "Z");
  if (!depth && !low) return null;
  const rise = riseToSafe(machine);
  if (rise < 0.01) return null;
  const stopped = run && !run.open || trouble;
  const above = t`only ${machine.mill.work_mm[2].toFixed(1)} mm above the block`;
  const deep = stopped ? t`${depthWords(depth)} in the block` : t`${depthWords(depth)} below the block's top`;
  const where = depth ? deep : above;
  const act = { label: t("Raise Z"), what: "jog", body: { by_mm: [0, 0, rise], feed_mm_per_min: RAISE_MM_PER_MIN } };
  const more = { kind: "warn", act, whole: true, bars: capital(RAISE) };
  return makeStep("raise", t`The tool stands ${where}: ${RAISE}`, more);
}

function depthWords(mm) {
  return mm < 0.1 ? `${mm.toFixed(3)} mm` : `${mm.toFixed(1)} mm`;
}

function findHomeStep({ mill, profile }) {
  if (mill.position_trusted || profile?.homing === false || !isPlaced(mill)) return null;
  return makeStep("home", t("home the mill, so that it knows where it is."), { act: HOME });
}

/** The program comes first: it determines the tool and the block for the zero. */
function findSetupStep(link, load, { ticked, named, byHand }) {
  const { machine, run, before } = link;
  if (!run?.open) return findLoadStep(run, load, byHand);
  if (run.state === "preparing") return makeStep("wait", t("wait, the program is on its way to the mill."), { kind: "busy" });
  if (run.state !== "parked") return makeStep("wait", t("read the message about the program."), { go: "program" });
  const doubt = run.travel_in_doubt && isZeroSet(machine, run, before) && { words: ticked || isDry(run) ? IN_DOUBT_TICKED[isDry(run)] : IN_DOUBT, kind: "warn", whole: true };
  const foreign = findForeignAxes(machine, run, before);
  const place = findPlaceStep(link, foreign);
  if (place) return place;
  if (ticked && machine.mill.spindle_on) return makeStep("spindle", t("switch the spindle off."), { act: OFF, bars: t("The spindle turns.") });
  if (ticked && !foreign.includes("Z")) return { ...(named ? makeStep("start", isDry(run) ? t("start the dry pass: nothing is cut.") : t("start the program."), { act: START }) : makeStep("tick", t("give your name, then start."), { go: "program" })), ...doubt };
  return findZeroStep(machine, run.setup ?? {}, foreign) ?? findOffStep(machine) ?? { ...makeStep("tick", t("look, tick the list, then start."), { go: doubt ? "jog" : "program" }), ...doubt };
}

/** Only a person knows whether X0 Y0 of another block fits this one; no program starts before the answer. */
function findPlaceStep({ machine, run, before, sameBlock }, foreign) {
  if (!/[XY]/.test(foreign) || !isZeroKnown(machine, "XY") || sameBlock(run)) return null;
  const same = { label: t("Same place"), same: true };
  if (sameBlock(run) === false) return { ...findCornerStep(machine, run.setup ?? {}), other: same, bars: t("Set X and Y first.") };
  const name = before.job_name ? cutName(before.job_name) : t("another job");
  const more = { kind: "warn", act: same, other: { label: t("Set again"), same: false }, whole: true, bars: t("Say above where X0 Y0 is.") };
  return makeStep("place", t`X0 Y0 was set for ${name}: is the same block clamped in the same place?`, more);
}

/** Where Z = 0 was just set, the tool touches the block. */
function findOffStep({ mill, profile }) {
  const stands = isPlaced(mill) && mill.state === "idle" && Math.abs(mill.work_mm[2]) < CLEAR_MM;
  const up = stands ? Math.min(UP_MM, riseToSafe({ mill, profile: { ...profile, safe_z_mm: UP_MM } })) : 0;
  if (up < CLEAR_MM) return null;
  const act = { label: t("Raise Z"), what: "jog", body: { by_mm: [0, 0, up], feed_mm_per_min: RAISE_MM_PER_MIN } };
  return makeStep("off", t("raise the tool a little, then tick the list."), { act });
}

/** null if the zero is valid, or if that is not known because the link reports no position. foreign: axes of another block. */
function findZeroStep(machine, setup, foreign) {
  if (!isPlaced(machine.mill)) return null;
  if (!isZeroKnown(machine, "XY")) return findCornerStep(machine, setup);
  const toolStays = !foreign && setup.change && setup.change.from_radius_mm === setup.change.to_radius_mm;
  const ended = machine.mill.needs?.length > 0 && !toolStays; // a program has one; this one is for another tool or block
  if (!ended && !foreign.includes("Z") && isZeroKnown(machine, "Z")) return null;
  return findTopStep(machine, ended && setup.change ? t`change to ${ball(setup.tool.radius_mm)}, then ` : "");
}

function findCornerStep(machine, setup) {
  const margin = setup.stock?.margin_mm;
  const mount = setup.tool?.radius_mm ? t`clamp the block, put in ${ball(setup.tool.radius_mm)}; ` : "";
  if (isAtHome(machine, "XY")) return makeStep("corner", t`${mount}jog over the lens's front left corner${machine.simulated ? t(" (simulated: leave room to the right and behind)") : ""}.`, { go: "jog" });
  const where = Number.isFinite(margin) ? t` (${margin} mm inside the block)` : "";
  return makeStep("zero", t`jog over the front left corner of the lens${where}; set X and Y.`, { act: ZERO_XY });
}

function findTopStep(machine, before) {
  if (isAtHome(machine, "Z")) return makeStep("top", t`${before}lower the tool onto the block's top${machine.simulated ? t(" (simulated: any place)") : ""}.`, { go: "jog" });
  return makeStep("zero", t`${before}touch the block's top with the tool; set Z.`, { act: ZERO_Z });
}

function findLoadStep(run, { ready, jobs, atWork, preset }, byHand) {
  const none = ready && !jobs;
  if (atWork && !preset?.meant) return makeStep("wait", t`wait for the running job (${atWork} is done), then load its program here. Clamp the block meanwhile.`, { kind: "busy" });
  if (none) return makeStep("make", t("make a lens: its programs are loaded here."), { go: "load" });
  if (preset?.meant) return makeStep("load", loadWords(run, preset), { act: LOAD });
  if (run && isCut(run) && !run.next) return makeStep("done", doneWords(run, byHand), { go: "program" });
  return preset ? makeStep("load", loadWords(run, preset), { act: LOAD }) : makeStep("load", t("load a program."), { go: "load" });
}

/** Only for the program that is selected in the card. */
function loadWords(run, { job, job_name: name, program }) {
  const follows = run && isCut(run) && run.job === job && run.next?.name === program;
  return follows ? t`load the next program of ${cutName(name)}, ${program}.` : t`load ${programWords(program, cutName(name))}.`;
}

/** A job's name, shortened for a line with little room. */
function cutName(name) {
  const whole = jobName({ name });
  return whole.length > NAME ? `${whole.slice(0, NAME - 1)}…` : whole;
}

function doneWords({ job_name: name }, byHand) {
  if (byHand) return t("take the lens out and finish it by hand.");
  return name ? t`the lens of ${cutName(name)} is milled: take it out, or load another program.` : t("the lens is milled: take it out, or load another program.");
}

/** {kind, wrong, next, more, step}, or null if nothing is wrong; more: details on demand. step: the next step, if a button does it. */
export function troubleOf(link) {
  const { machine, run, away, gone } = link;
  if (gone) return makeTrouble("bad", sentence(gone), t("go back to the list of machines."));
  if (away) return makeTrouble("bad", t("The server does not answer."), t("to stop, use the button on the mill."), t("The mill goes on with what it has; the page shows its last report. The page goes on by itself when the server is back."));
  if (!machine) return null;
  if (machine.problem) return makeTrouble("bad", t("The file of this machine has an error."), t("correct it; this page sees it at once."), machine.problem);
  if (!machine.agent.reachable) return makeTrouble("bad", t("The server has lost this mill."), machine.remote ? t("look at the mill, then at the computer beside it.") : t("look at the mill, then start the server again."), t`${outOfReach(machine)} The mill may still be moving: stop it with its own button.`);
  return troubleOfMill(machine) ?? troubleOfRun(machine, run);
}

function makeTrouble(kind, wrong, next, more = "", step = "") {
  return { kind, wrong, next, more, step };
}

function troubleOfMill({ mill, run, profile }) {
  if (mill.state === "connecting") return makeTrouble("busy", t("Connecting to the mill."), t("wait a few seconds."));
  if (!mill.connected) return makeUnpluggedTrouble(mill, run);
  switch (mill.state) {
    case "alarm":
      return makeLockedTrouble(mill, run, profile);
    case "door":
      return makeTrouble("warn", t("The safety door is open."), t("close it, then Resume; or STOP."));
    case "tool":
      return makeTrouble("warn", t("A tool change is due."), t("change it, then Resume; or STOP."));
    case "sleep":
      return makeTrouble("warn", t("The mill is asleep, its motors are off."), t("reset it, then home it."), t("It may have been moved by hand: without homing, set the work zero again."));
    default:
      return null;
  }
}

/** Nothing is wrong with a mill that was only switched on. */
function makeLockedTrouble(mill, run, profile) {
  const { brief, whole } = millWords(mill);
  const homes = profile?.homing !== false;
  const next = homes ? t("check that the tool is free to rise, then home the mill.") : t("check that the tool is free, unlock, set the zero again.");
  return makeTrouble(mill.alarm || run ? "bad" : "", brief || t("The mill is locked."), next, t`${whole} Unlock only if you know where the tool is.`, homes ? "home" : "");
}

function makeUnpluggedTrouble(mill, run) {
  const latched = mill.latched ? t` Your ${orderWord(mill.latched)} is carried out first when the mill is back.` : "";
  const cut = run?.state === "interrupted" ? t(" Its program is interrupted; what was cut is known.") : "";
  return makeTrouble(
    "bad",
    t("The mill is not connected."),
    t("look at the mill, then at cable and power."),
    t`${millWords(mill).whole}${cut} It may still carry out what it holds, and the spindle may turn: stop it with its own button. The server finds it again by itself; that moves nothing.${latched}`,
  );
}

function troubleOfRun(machine, run) {
  if (!run?.required_checks?.includes("position")) return null;
  const [, word] = RUN_STATES[run.state] ?? ["", run.state];
  const line = run.executed_line ? t` at line ${thousands(run.executed_line)}` : "";
  const more = t`${describe(run).whole} The part is not lost, and nothing moves before you say so.`;
  return makeTrouble(run.state === "aborted" ? "warn" : "bad", t`The program was ${word}${line}.`, t("go on with it, step by step."), more, "recover");
}
