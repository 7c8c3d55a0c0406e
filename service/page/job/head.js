/** Name and state of a job, its actions, and the next step after a failure. */
import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { confirm, open, toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { isGoing, shape, stateMark } from "../lib/state.js";
import { ago, jobName, sentence } from "../lib/words.js";
import { setUpWords, stageWords } from "./figures.js";
import { settingWords } from "./setting_words.js";

/** {node, update(job)}; `changed(job)` is called after an action; `app` opens other screens. */
export function headPart(app, changed) {
  const title = h("h1"), state = h("span", { class: "job-state" }), about = h("p", { class: "job-about dim" });
  const actions = h("div", { class: "row job-actions" }), notice = h("div", { role: "status" });
  const node = h("header", { class: "job-head" }, h("div", {}, h("div", { class: "job-title" }, title, state), about), actions, notice);
  let shown = "";

  function update(job) {
    write(title, jobName(job));
    app.title(jobName(job));
    const facts = [setUpWords(job.spec), presetWords(job.spec), whenWords(job, api.now())];
    write(about, facts.filter(Boolean).join(" · "));
    const key = JSON.stringify([job.state, job.cancel_requested, job.error, job.queue_position]);
    if (key === shown) return;
    shown = key;
    replace(state, stateMark(job.state, job.cancel_requested && job.state === "running" ? t("being cancelled") : undefined));
    replace(actions, buttons(job));
    replace(notice, noticeOf(job));
  }
  function buttons(job) {
    const going = isGoing(job);
    const again = job.state === "failed" || job.state === "cancelled";
    return [
      going && h("button", { type: "button", disabled: job.cancel_requested, onclick: () => act(job, "cancel") }, t("Cancel")),
      again && h("button", { type: "button", class: "primary", onclick: () => act(job, "retry") }, t("Try again")),
      h("a", { class: "button", href: `#/new?from=${job.id}` }, t("Duplicate with changes")),
      job.state === "succeeded" && h("button", { type: "button", onclick: () => chooseOther(job, app) }, t("Compare with…")),
      job.state !== "running" && h("button", { type: "button", class: "quiet", onclick: () => remove(job) }, t("Delete")),
    ];
  }
  async function act(job, what) {
    if (!(await api.need("jobs:write"))) return;
    await runAndReport(async () => changed(await api.post(`/v1/jobs/${job.id}:${what}`)));
  }
  async function remove(job) {
    const sure = await confirm({
      title: t("Delete this job?"), words: t`${jobName(job)}, its pictures and its programs will be gone. This cannot be undone.`,
      yes: t("Delete"), no: t("Keep"), danger: true,
    });
    if (!sure || !(await api.need("jobs:write"))) return;
    await runAndReport(async () => {
      await api.delete(`/v1/jobs/${job.id}`);
      toast(t`${jobName(job)} was deleted.`);
      app.go("#/");
    });
  }
  return { node, update };
}

async function runAndReport(work) {
  try {
    await work();
  } catch (error) {
    toast(error.detail ?? error.message, { kind: "bad" });
  }
}

function presetWords({ preset, passes }) {
  if (preset === "recommended" && passes.length) return t("passes as given");
  return { recommended: t("passes as recommended"), draft: t("draft"), paper: t("passes of the paper") }[preset] ?? "";
}

/** The time at which it reached its state. */
function whenWords(job, now) {
  if (job.ended_at) return endWords(job.state, ago(job.ended_at, now));
  if (job.started_at) return t`begun ${ago(job.started_at, now)}`;
  return t`sent ${ago(job.created_at, now)}`;
}

function endWords(state, when) {
  if (state === "succeeded") return t`done ${when}`;
  return state === "failed" ? t`failed ${when}` : t`ended ${when}`;
}

/** The fault and the next step; nothing for a job without a fault. */
function noticeOf(job) {
  if (job.state === "cancelled") {
    const words = t("This job was cancelled. Try again goes on with the steps that were finished.");
    return h("p", { class: "notice" }, shape("off"), h("span", {}, words));
  }
  if (job.state !== "failed" || !job.error) return null;
  const { stage, detail, field } = job.error, where = stage ? stageWords(stage, job.spec) : t("the start");
  const duplicate = h("a", { href: `#/new?from=${job.id}` }, t("duplicate with changes"));
  const what = field && settingWords(field.replace(/^spec\./, ""), job.spec);
  const next = field
    ? h("span", {}, t("Change "), h("strong", {}, what), ": ", duplicate, ".")
    : t("Try again goes on with the steps that were finished. If it fails again, the server's log says more.");
  return h(
    "div", { class: "notice bad" }, shape("bad"),
    h("div", {}, h("p", {}, h("strong", {}, t`Stopped at: ${where}.`)), h("p", {}, sentence(detail)), h("p", {}, next)),
  );
}

/** Lets a person choose a finished job for comparison with this one. */
async function chooseOther(job, app) {
  await runAndReport(async () => {
    const other = await openJobs(job);
    if (other) app.go(`#/compare/${job.id}/${other}`);
  });
}

/** Resolves with the id of the chosen job, or null. */
async function openJobs(job) {
  const { jobs } = await api.get("/v1/jobs?state=succeeded&limit=50");
  const others = jobs.filter(({ id }) => id !== job.id);
  const choice = (other, close) => {
    const when = h("span", { class: "dim" }, ago(other.ended_at ?? other.created_at, api.now()));
    return h("li", {}, h("button", { type: "button", onclick: () => close(other.id) }, jobName(other), " ", when));
  };
  const body = (close) =>
    others.length
      ? h("ul", { class: "choose-jobs" }, others.map((other) => choice(other, close)))
      : h("p", {}, t("There is no other finished job yet."));
  return open({ title: t`Compare ${jobName(job)} with`, body, actions: [{ words: t("Cancel"), value: null }] });
}
