/** The program that is on the mill: waiting for its start, under way, or over. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { isCut, isDry, mark, shape } from "../lib/state.js";
import { ball, hours, percent, sentence, thousands } from "../lib/words.js";
import { programRows } from "../job/figures.js";
import { workClock } from "../job/work_clock.js";
import { checklist } from "./checklist.js";
import { notifySwitch } from "./notify.js";
import { enable, guardedButton, refusalLine } from "./order_controls.js";
import { RUN_STATES, describe } from "./sentences.js";
import { isZeroKnown, isZeroSet } from "./place.js";
import { leftWords, programWords, runStanding, secondsLeft, whyNot } from "./words.js";

export function runCard(link) {
  const words = refusalLine();
  const state = h("div", {});
  const title = h("h2", { id: "run-title" });
  const more = h("div", { class: "stack" });
  const progress = meter();
  const node = h("section", { class: "card running", "aria-labelledby": "run-title" }, h("div", { class: "row spread" }, title, state), progress.node, more);
  let shown = "";
  let list = null;
  let frame = null;
  let idle = true;
  let setup = ""; // `setup` of the mill, on which the start depends, as reported when the list last had no tick

  async function start(given) {
    try {
      await link.toRun("start", { ...given, setup });
    } catch (error) {
      if (error.code === "setup_changed") list?.clear();
      throw error;
    }
  }

  let byHand = ""; // the run after which a hand finishes the lens
  const isByHand = (run) => ((byHand = run.id), link.changed());
  let zeroed = ""; // the run for which every zero was set: its messages then stay, and Start keeps its place
  const isZeroed = (run) => {
    if (!link.machine?.mill || isZeroSet(link.machine, run, link.before)) zeroed = run.id;
    return zeroed === run.id;
  };
  const fill = (run) => {
    const parked = run.state === "parked";
    list = parked ? checklist(run, { label: isDry(run) ? t`Start the dry pass of ${run.program.name}` : t`Start ${run.program.name}`, words, act: (given) => words.run(() => start(given)), changed: () => link.changed() }) : null;
    frame = parked ? frameButton(link, words) : null;
    replace(more, dryNote(run), notes(run, !parked || isZeroed(run)), aboutSpindle(run, link.machine?.profile), parked ? startControls(link, list, frame, words) : words.node, parked && !isDry(run) && !link.isTried && h("p", { class: "dim" }, t("A first run? Take it off the mill and load it as a dry pass: it shows the way and cuts nothing.")), isCut(run) && !run.next && afterLast(run, isByHand));
  };
  return {
    node,
    get ticked() {
      return Boolean(list?.ticked);
    },
    get named() {
      return Boolean(list?.named);
    },
    get button() {
      return list?.button;
    },
    get byHand() {
      return byHand !== "" && byHand === link.run?.id;
    },
    update(nextStep) {
      const { run } = link;
      node.hidden = !run;
      if (!run) return;
      const now = `${run.id} ${run.state} ${run.warnings?.length} ${run.words} ${isZeroed(run)}`;
      if (!shown.startsWith(run.id)) words.clear(); // the message was about another run
      if (now !== shown) fill(run);
      shown = now;
      const [kind, word] = link.away ? ["off", t`last seen ${runStanding(run, link.machine)[1]}`] : runStanding(run, link.machine);
      if (state.textContent !== word) replace(state, mark(kind, word));
      const program = programWords(run.program.name, run.job_name);
      write(title, `${isDry(run) ? t`Dry pass of ${program}` : program}${run.setup?.tool ? t`, ball ${ball(run.setup.tool.radius_mm)}` : ""}`);
      progress.update(run, link.machine?.simulated);
      const stands = link.machine?.mill?.state === "idle";
      const rests = link.machine?.mill?.setup;
      if (idle && !stands) list?.clear(t("The mill has moved since: look again."));
      else if (rests !== setup) list?.clear(t("Zero or position have changed since: look again."));
      [idle, setup] = [stands, rests];
      list?.update(whyNot(link) || nextStep.bars, nextStep.step === "tick");
      const mayMove = whyNot(link) === "" && isZeroKnown(link.machine, "XYZ");
      if (frame) enable([frame.button], mayMove && !link.busy);
      if (!mayMove) frame?.close();
    },
  };
}

function meter() {
  const share = h("strong", {});
  const bar = h("progress", { max: 1, "aria-label": t("Cut so far") });
  const line = h("span", {});
  const live = h("div", { class: "row spread" }, line, notifySwitch());
  const left = h("span", { class: "left-over" });
  const when = h("p", { class: "when" });
  const whole = h("p", { class: "whole" });
  const wholeBar = h("progress", { class: "thin", max: 1, "aria-label": t("Cut of the whole job") });
  const node = h("div", { class: "meter" }, h("div", { class: "row spread figures" }, share, left), bar, when, live, whole, wholeBar);
  let [job, passes] = ["", []];

  async function learn(id) {
    job = id;
    passes = [];
    const found = await api.get(`/v1/jobs/${id}`).catch(() => null); // without it there is still the run itself
    if (job === id) passes = programRows(found?.report);
  }

  return {
    node,
    update(run, simulated) {
      const isParked = run.state === "parked";
      bar.hidden = live.hidden = isParked || run.state === "finished";
      write(share, isParked ? "" : percent(run.share));
      bar.value = run.share;
      write(line, run.lines ? t`line ${thousands(run.executed_line)} of ${thousands(run.lines)}` : "");
      const isOver = ["finished", "aborted"].includes(run.state);
      write(left, isOver ? "" : leftWords(run, simulated));
      write(when, isOver ? "" : runTimeWords(run, Date.now(), simulated));
      if (run.job !== job) learn(run.job);
      const all = findWholeJob(passes, run, simulated), isAll = isCut(run) && !run.next && !all?.left_s; // the work by hand is said in its place
      node.hidden = isAll || run.state === "preparing" || run.state === "refused";
      write(whole, wholeJobWords(all));
      wholeBar.hidden = !all;
      wholeBar.value = all?.share ?? 0;
    },
  };
}

/** After the last pass: what is left to do by hand, with its clock; isByHand(run): there is something. */
function afterLast(run, isByHand) {
  const node = h("div", { class: "stack by-hand" }, h("p", {}, t("That was the last pass: the lens is milled.")));
  const show = ({ report }) => {
    const { title, minutes, steps } = report?.finishing ?? {};
    if (!(minutes > 0)) return;
    const how = steps.length > 0 && h("a", { href: `#/jobs/${run.job}?show=finishing` }, t("How it is done"));
    replace(node, h("h3", {}, t`Now by hand: ${title}`), workClock(run.job, minutes).node, how);
    isByHand(run);
  };
  api.get(`/v1/jobs/${run.job}`).then(show, () => {}); // without it there is still the run itself
  return node;
}

/** Plain words above everything else: this does not make a lens. */
function dryNote(run) {
  if (!isDry(run)) return null;
  const higher = t`Dry pass: the program runs ${run.lift_mm} mm higher, with spindle and coolant off. Nothing is cut.`;
  const over = t`That was a dry pass, ${run.lift_mm} mm higher: nothing was cut. Load the program again to cut it.`;
  return h("p", { class: "notice warn dry" }, shape("warn"), h("span", {}, run.state === "finished" ? over : higher));
}

function notes(run, zeroed) {
  const own = ["interrupted", "aborted"].includes(run.state) ? "" : describe(run).whole; // shown above, with what to do
  const kind = RUN_STATES[run.state]?.[0] === "bad" ? "bad" : "warn";
  const notice = own && h("p", { class: `notice ${kind}` }, shape(kind), h("span", {}, own));
  return [notice, run.state === "parked" || (run.state !== "finished" && run.warnings?.length) ? warningsNode(run, zeroed) : null];
}

/** All warnings in one line, which is there even without any; a person can unfold it. */
function warningsNode({ warnings = [], travel_in_doubt: travel, state }, zeroed) {
  if (!zeroed && (travel || !warnings.length)) return h("p", { class: "warned dim" }, t("Whether it fits the travel is known once X, Y and Z are set."));
  if (!warnings.length) return h("p", { class: "warned good" }, shape("good"), t("No warnings"));
  const words = travel ? t("It may not fit the travel") : warnings.length === 1 ? t`${warnings.length} warning` : t`${warnings.length} warnings`;
  return h("details", { class: "warned warn", open: travel && state === "parked" }, h("summary", {}, shape("warn"), words), h("ul", {}, warnings.map((text) => h("li", {}, sentence(text).replaceAll(/(?<!\w)-(?=\d)/g, "−")))));
}

/** What the spindle does in a hold and without the computer: a person should know it before walking away. */
function aboutSpindle(run, profile) {
  const words = profile?.spindle?.words ?? [];
  if (!run.open || !words.length) return null;
  return h("details", { class: "warned" }, h("summary", {}, t("What the spindle does on HOLD or if the computer fails")), h("ul", {}, words.map((text) => h("li", {}, sentence(text)))));
}

/** The outline of the program at a safe height: it shows where the program will cut before it does. */
function frameButton(link, words) {
  return guardedButton(t("Frame the job"), {
    words: t("The tool goes up to the safe height, then once around the outline of the program, and cuts nothing. Is the way free?"),
    yes: t("Go around it"),
    act: () => words.run(() => link.order("frame", { program: link.run.program.sha256 })),
  });
}

function startControls(link, list, frame, words) {
  const back = guardedButton(t("Take it off the mill"), {
    words: t("The program leaves the mill; nothing has been cut by it."),
    yes: t("Take it off"),
    act: () => words.run(() => link.abandonRun()),
  });
  return [list.node, h("div", { class: "row" }, frame.node, back.node)];
}

const DAY_S = 86_400;

/** How long a run has taken, and when it will end, in words; "" if neither is known. now_ms: since 1970. */
export function runTimeWords({ started_at, time_left_s, state }, now_ms, simulated) {
  const begun_ms = Date.parse(started_at ?? "");
  const taken = begun_ms <= now_ms ? t`${hours((now_ms - begun_ms) / 1000)} since its start` : "";
  const ends = state === "running" && Number.isFinite(time_left_s) && !simulated ? t`ends about ${clock(now_ms, time_left_s)}` : "";
  return [taken, ends].filter(Boolean).join(", ");
}

function clock(now_ms, left_s) {
  const at = new Date(now_ms + 1000 * left_s);
  const time = at.toLocaleTimeString(locale, { hour: "2-digit", minute: "2-digit", hour12: false });
  return left_s > DAY_S / 2 ? `${at.toLocaleDateString(locale, { weekday: "short" })} ${time}` : time;
}

/**
 * {number, count, share, left_s} of a job with several programs, by their time; null without that, and in a dry pass.
 * passes: {file, time_s} in order, as the job's report has them.
 */
export function findWholeJob(passes, run, simulated) {
  const here = passes.findIndex(({ file }) => file === run.program.name);
  if (here < 0 || passes.length < 2 || isDry(run)) return null;
  const here_s = run.time_s || passes[here].time_s; // as the mill counts it, like what is left
  const total_s = passes.reduce((sum, one, k) => sum + (k === here ? here_s : one.time_s), 0);
  if (!(total_s > 0)) return null;
  const leftOut = new Set(run.left_out.map(({ name }) => name));
  const isLeft = ({ file }, k) => k > here || (k < here && leftOut.has(file));
  const others_s = passes.filter(isLeft).reduce((sum, one) => sum + one.time_s, 0);
  const left_s = others_s + here_s * leftOf(run, simulated);
  return { number: here + 1, count: passes.length, share: 1 - left_s / total_s, left_s };
}

/** The part of this run that is left, by time, 0 to 1. */
function leftOf(run, simulated) {
  if (run.state === "finished") return 0;
  const left_s = secondsLeft(run, simulated);
  return run.time_s > 0 && Number.isFinite(left_s) ? Math.min(1, left_s / run.time_s) : 1 - run.share;
}

export function wholeJobWords(whole) {
  if (!whole?.left_s) return whole ? t`Program ${whole.number} of ${whole.count}. The whole job is cut.` : "";
  return t`Program ${whole.number} of ${whole.count}. The whole job: ${percent(whole.share)} cut, ${hours(whole.left_s)} of milling left`;
}
