/**
 * How far a job is, stage by stage, and how long it will take to its end. Every stage has a time that it usually takes;
 * the finished stages, and the share of the present one, show how much slower or faster this computer is today.
 */
import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isGoing, mark } from "../lib/state.js";
import { capital, hours, percent, percentUnderWay } from "../lib/words.js";
import { stageWords } from "./figures.js";

const LOOKS = {
  waiting: ["wait", t("waiting")],
  running: ["busy", t("working")],
  committed: ["good", t("done")],
  reused: ["good", t("done before")],
  interrupted: ["warn", t("begins again")],
  failed: ["bad", t("failed")],
  cancelled: ["off", t("cancelled")],
};

/** {node, update(job, live)}; live: {stage, share, progress} of the last event, or null. */
export function progressPart() {
  const bar = h("progress", { max: 1, "aria-label": t("Progress of the job") });
  const words = h("span", { class: "progress-words" });
  const list = h("ol", { class: "stages" });
  const details = h("details", {}, h("summary", {}, words), list);
  const node = h("section", { class: "card job-progress", "aria-label": t("Progress") }, bar, details);
  let shown = null, before = null;

  function update(job, live, link) {
    const busy = isGoing(job);
    const share = busy && live ? Math.max(job.progress, live.progress) : job.progress;
    bar.hidden = job.state === "succeeded" || job.state === "queued";
    bar.value = share;
    write(words, sentence(job, share, live, link));
    if (before !== job.state) details.open = job.state === "failed";
    before = job.state;
    const key = JSON.stringify([job.stages, job.state]);
    if (key !== shown) replace(list, job.stages.map((stage) => row(stage, job)));
    shown = key;
    const running = list.querySelector("[data-state=running] .stage-share");
    if (running && live && live.stage === running.dataset.stage) write(running, percent(live.share));
  }
  return { node, update };
}

function row(stage, job) {
  const [kind, word] = LOOKS[stage.state] ?? ["off", stage.state];
  const time = stage.state === "reused" || stage.seconds === null ? "" : hours(stage.seconds);
  return h(
    "li",
    { dataset: { state: stage.state } },
    h("span", { class: "stage-name" }, stageWords(stage.name, job.spec)),
    h("span", { class: "stage-share dim", dataset: { stage: stage.name } }, time),
    mark(kind, word),
  );
}

function waitWords(before) {
  return before === 1 ? t`Waits: ${before} job before this one.` : t`Waits: ${before} jobs before this one.`;
}

function sentence(job, share, live, link) {
  if (job.state === "queued") {
    const place = job.queue_position;
    return place > 1 ? waitWords(place - 1) : t("Waits: it is the next one.");
  }
  if (job.state === "running") {
    const stage = live?.stage ?? job.stage, tail = link === "away" ? t(" Not live at the moment: trying again.") : "";
    const left = job.cancel_requested ? "" : ` ${capital(leftWords(secondsLeft(job, live, api.now())))}.`;
    const doing = job.cancel_requested ? t("Being cancelled") : stage ? stageWords(stage, job.spec) : t("Begins");
    return `${percentUnderWay(share)}: ${doing}.${left}${tail}`;
  }
  const took = job.started_at && job.ended_at ? hours((Date.parse(job.ended_at) - Date.parse(job.started_at)) / 1000) : "";
  if (job.state === "succeeded") return took ? t`Worked out in ${took}.` : t("Worked out.");
  return t`Stopped at ${percent(share)}${took ? t` after ${took}` : ""}.`;
}

const TRUST_S = 3; // seconds of measured work from which the measured pace counts more than the usual one
const TELLING = 0.05; // share of a stage from which its own pace is used
const EITHER_WAY = 2; // how much longer than predicted a stage may take
const MEASURED_S = 2; // seconds of usual work done here from which the pace is known: the first job compiles what later jobs find ready
const SOME_MINUTES_S = 600;

/**
 * {low, high, known}: seconds that are left of a running job, never less than is certain; known: the passes are planned, and
 * the pace of this computer was measured. live: {stage, share} or null.
 */
export function secondsLeft(job, live, now) {
  const pace = paceOf(job.stages);
  const planned = !job.stages.some(({ name, state }) => name === "passes" && state !== "committed" && state !== "reused");
  let low = 0, paced = 0;
  for (const stage of job.stages) {
    const usual = pace * stage.usual_s, share = live?.stage === stage.name ? live.share : 0;
    if (stage.state === "running") low += ofRunning(stage, usual, share, now);
    else if (stage.state === "waiting" || stage.state === "interrupted") low += usual;
    if (isPaced(stage)) paced += stage.usual_s * ({ running: share, committed: 1, reused: 1 }[stage.state] ?? 0);
  }
  return { low, high: low * EITHER_WAY, known: planned && paced >= MEASURED_S };
}

/** "about 3 min left", "3 to 5 min left", "less than a minute left"; if it is not known, only whether it takes minutes or longer. */
export function leftWords({ low, high, known }) {
  if (!known) return low < SOME_MINUTES_S ? t("a few minutes left") : t`at least ${Math.floor(low / 60)} min left`;
  const [from, to] = [low, high].map((seconds) => Math.ceil(seconds / 60));
  if (high < 60) return t("less than a minute left");
  if (to >= 120) return inHours(Math.round(low / 3600), Math.ceil(high / 3600));
  return from === to ? t`about ${to} min left` : t`${from} to ${to} min left`;
}

function inHours(from, to) {
  return from === to ? t`about ${from} h left` : t`about ${from} to ${to} h left`;
}

/** A plan that an estimate has made is only read, which says nothing about the pace. */
const isPaced = ({ name }) => name !== "passes";

/** How much longer stages take here than usual; reused stages do not count. */
function paceOf(stages) {
  const done = stages.filter((stage) => stage.state === "committed" && stage.seconds !== null && isPaced(stage));
  const sum = (key) => done.reduce((total, stage) => total + stage[key], TRUST_S);
  return sum("seconds") / sum("usual_s");
}

/** The longer of the usual remaining time and that at its own pace. A stage that is late is expected to take that much longer again. */
function ofRunning({ started_at: startedAt, usual_s: usualS }, usual, share, now) {
  const spent = Math.max(0, (now - Date.parse(startedAt)) / 1000);
  const own = share > TELLING ? (spent * (1 - share)) / share : 0;
  const late = share > TELLING ? 0 : Math.max(0, spent - usual);
  return Math.max(usual * (1 - share), own, late, usualS * 0.05);
}
