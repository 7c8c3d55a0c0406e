/** A program from a job onto the mill, where it waits for a person. Nothing moves by that. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mayBeMilled, shape } from "../lib/state.js";
import { ago, jobName, percent } from "../lib/words.js";
import { enable, refusalLine } from "./refusal_line.js";
import { whyNot } from "./words.js";

const AGAIN_MS = 3000;
const NONE_MS = 10_000;
const STANDS = ["idle", "alarm", "check", "sleep", "door", "jog", "homing", "tool"];

/** chosen: {job, program} from the address of the page; a program by its name or number. */
export function loadCard(link, chosen) {
  const words = refusalLine();
  const jobs = h("select", { onchange: () => ((chosen = { job: jobs.value }), choose(jobs.value)) });
  // An answer that is still on its way must not put another program in the place of the one that was taken.
  const passes = h("select", { onchange: () => (chosen = { job: jobs.value, program: passes.value }) });
  const load = h("button", { type: "button", onclick: () => words.run(() => link.load(jobs.value, passes.value)) }, t("Load onto the mill"));
  const reason = h("p", { class: "missing", role: "status" });
  const form = h("div", { class: "load-form" }, field(t("Job"), jobs), field(t("Program"), passes), load, reason);
  const none = h("p", { class: "dim" }, t("No job has programs yet. "), h("a", { href: "#/new" }, t("Make one")), t(": its programs can be loaded here."));
  const node = h("section", { class: "card loading", "aria-labelledby": "loading-title" }, h("h2", { id: "loading-title" }, t("Load a program")), none, form, words.node);
  const later = h("p", { class: "notice busy", hidden: true }, shape("busy"), h("span", {}));
  node.insertBefore(later, form);
  none.hidden = form.hidden = true;
  const facts = { ready: false, jobs: 0, atWork: false };
  let timer = 0;

  const again = () => words.run(list);

  async function list() {
    const { jobs: all } = await api.get("/v1/jobs?state=running&state=succeeded&limit=50");
    const found = await withPrograms(all);
    replace(jobs, found.map((job) => h("option", { value: job.id, selected: job.id === chosen.job }, `${jobName(job)}, ${ago(job.created_at, api.now())}`)));
    const meant = chosen.job && !found.some((job) => job.id === chosen.job) ? await api.get(`/v1/jobs/${chosen.job}`) : null;
    waitFor(meant ?? (found.length ? null : all[0]));
    Object.assign(facts, { ready: true, jobs: found.length, atWork: !later.hidden });
    none.hidden = found.length > 0 || !later.hidden;
    form.hidden = found.length === 0;
    if (found.length) await choose(jobs.value);
    else if (later.hidden) timer = setTimeout(again, NONE_MS);
    link.changed();
  }

  /** A job that is still being worked on is looked at again until it is done. */
  function waitFor(job) {
    clearTimeout(timer);
    later.hidden = !job || !["queued", "running"].includes(job.state);
    if (later.hidden) return;
    write(later.lastChild, t`${jobName(job)} is still being worked on (${percent(job.progress)}). Its programs can be loaded once all of them have been checked.`);
    timer = setTimeout(again, AGAIN_MS);
  }

  async function choose(id) {
    const [job, done] = await Promise.all([api.get(`/v1/jobs/${id}`), finished(id)]);
    if (jobs.value !== id) return;
    const meant = id === chosen.job && job.programs.find((one) => [one.name, String(one.number)].includes(chosen.program));
    const first = meant || (job.programs.find((one) => !done.has(one.sha256)) ?? job.programs[0]);
    replace(passes, job.programs.map((one) => h("option", { value: one.name, selected: one === first }, done.has(one.sha256) ? t`${one.name} (done on this mill)` : one.name)));
    link.changed();
  }

  async function finished(id) {
    const { runs } = await api.get(`/v1/runs?machine=${encodeURIComponent(link.name)}&job=${id}&limit=100`);
    return new Set(runs.filter((run) => run.state === "finished").map((run) => run.program.sha256));
  }

  again();
  return {
    node,
    /** The jobs are looked at anew when a program has left the mill. */
    again: () => ((chosen = { job: jobs.value || chosen.job }), again()),
    close: () => clearTimeout(timer),
    /** What the next step is told by: {ready, jobs, atWork}. */
    facts,
    update(nextStep) {
      const why = whyNot(link, STANDS, { besideRun: true });
      write(reason, link.machine?.mill?.state === "held" ? why : "");
      load.classList.toggle("primary", nextStep.step === "load");
      enable([load], why === "" && !link.busy && passes.value !== "");
    },
  };
}

/** Jobs at work have programs for a mill once those have been checked. */
async function withPrograms(jobs) {
  const whole = await Promise.all(jobs.map((job) => (job.state === "running" ? api.get(`/v1/jobs/${job.id}`) : null)));
  return jobs.filter((job, k) => !whole[k] || mayBeMilled(whole[k]));
}

function field(label, control) {
  return h("label", { class: "field" }, h("span", {}, label), control);
}
