/** Name and state of a job, what can be done with it, and what to do next where something went wrong. */
import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { confirm, toast } from "../lib/dialog.js";
import { shape, stateMark } from "../lib/state.js";
import { ago, jobName, sentence } from "../lib/words.js";
import { setUpWords, stageWords } from "./figures.js";
import { settingWords } from "./setting_words.js";

/** {node, update(job)}; `changed(job)` after something was done, `app` to go elsewhere. */
export function headPart(app, changed) {
  const title = h("h1"), state = h("span", { class: "job-state" }), about = h("p", { class: "job-about dim" });
  const actions = h("div", { class: "row job-actions" }), notice = h("div", { role: "status" });
  const node = h("header", { class: "job-head" }, h("div", { class: "job-title" }, title, state), about, actions, notice);
  let shown = "";

  function update(job) {
    write(title, jobName(job));
    app.title(jobName(job));
    const facts = [setUpWords(job.spec), presetWords(job.spec), whenWords(job, api.now())];
    write(about, facts.filter(Boolean).join(" · "));
    const key = JSON.stringify([job.state, job.cancel_requested, job.error, job.queue_position]);
    if (key === shown) return;
    shown = key;
    replace(state, stateMark(job.state, job.cancel_requested && job.state === "running" ? "being cancelled" : undefined));
    replace(actions, buttons(job));
    replace(notice, noticeOf(job));
  }
  function buttons(job) {
    const going = job.state === "running" || job.state === "queued";
    const again = job.state === "failed" || job.state === "cancelled";
    return [
      going && h("button", { type: "button", disabled: job.cancel_requested, onclick: () => act(job, "cancel") }, "Cancel"),
      again && h("button", { type: "button", class: "primary", onclick: () => act(job, "retry") }, "Try again"),
      h("a", { class: "button", href: `#/new?from=${job.id}` }, "Duplicate with changes"),
      job.state === "succeeded" && h("button", { type: "button", onclick: () => chooseOther(job, app) }, "Compare with…"),
      job.state !== "running" && h("button", { type: "button", class: "quiet", onclick: () => remove(job) }, "Delete"),
    ];
  }
  async function act(job, what) {
    if (!(await api.need("jobs:write"))) return;
    await runAndReport(async () => changed(await api.post(`/v1/jobs/${job.id}:${what}`)));
  }
  async function remove(job) {
    const sure = await confirm({
      title: "Delete this job?", words: `${jobName(job)}, its pictures and its programs will be gone. This cannot be undone.`,
      yes: "Delete", no: "Keep", danger: true,
    });
    if (!sure || !(await api.need("jobs:write"))) return;
    await runAndReport(async () => {
      await api.delete(`/v1/jobs/${job.id}`);
      toast(`${jobName(job)} was deleted.`);
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
  if (preset === "recommended" && passes.length) return "passes as given";
  return { recommended: "passes as recommended", draft: "draft", paper: "passes of the paper" }[preset] ?? "";
}

/** Since when it is what it is. */
function whenWords(job, now) {
  if (job.ended_at) return `${{ succeeded: "done", failed: "failed" }[job.state] ?? "ended"} ${ago(job.ended_at, now)}`;
  if (job.started_at) return `begun ${ago(job.started_at, now)}`;
  return `sent ${ago(job.created_at, now)}`;
}

/** What went wrong and the next step; nothing for a job that goes its way. */
function noticeOf(job) {
  if (job.state === "cancelled") {
    const words = "This job was cancelled. Try again goes on with the steps that were finished.";
    return h("p", { class: "notice" }, shape("off"), h("span", {}, words));
  }
  if (job.state !== "failed" || !job.error) return null;
  const { stage, detail, field } = job.error, where = stage ? stageWords(stage, job.spec) : "the start";
  const duplicate = h("a", { href: `#/new?from=${job.id}` }, "duplicate with changes");
  const what = field && settingWords(field.replace(/^spec\./, ""), job.spec);
  const next = field
    ? h("span", {}, "Change ", h("strong", {}, what), ": ", duplicate, ".")
    : "Try again goes on with the steps that were finished. If it fails again, the server's log says more.";
  return h(
    "div", { class: "notice bad" }, shape("bad"),
    h("div", {}, h("p", {}, h("strong", {}, `Stopped at: ${where}.`)), h("p", {}, sentence(detail)), h("p", {}, next)),
  );
}

/** Lets a person choose a finished job to set beside this one. */
async function chooseOther(job, app) {
  await runAndReport(async () => {
    const { openJobs } = await import("./choose_job.js");
    const other = await openJobs(job);
    if (other) app.go(`#/compare/${job.id}/${other}`);
  });
}
