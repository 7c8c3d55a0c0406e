/** How far a job is, stage by stage. */
import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isGoing, mark } from "../lib/state.js";
import { capital, hours, percent, percentUnderWay } from "../lib/words.js";
import { stageWords } from "./figures.js";
import { leftWords, secondsLeft } from "./left.js";

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
