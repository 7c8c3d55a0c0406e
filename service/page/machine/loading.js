/** Loads a program of a job onto the mill, where it waits for a person. Nothing moves. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isCut, isGoing, mayBeMilled, shape } from "../lib/state.js";
import { ago, jobName, percent } from "../lib/words.js";
import { enable, refusalLine } from "./order_controls.js";
import { roomToLift } from "./place.js";
import { field } from "./probe.js";
import { addressOf, whyNot } from "./words.js";

const LIFT_MM = 20; // of a dry pass, where the mill has room for it
const AGAIN_MS = 3000;
const NONE_MS = 10_000;
const STANDS = ["idle", "alarm", "check", "sleep", "door", "jog", "homing", "tool"];

/**
 * chosen: {job, program} that a person means, from the address of the page or by hand; a program by its name or number.
 * Until it is on the mill nothing else is offered; without one, the program that follows the last run is offered.
 */
export function loadCard(link, chosen) {
  const words = refusalLine();
  const jobs = h("select", { onchange: () => ((chosen = { job: jobs.value }), link.changed(), choose(jobs.value)) });
  // A late answer must not replace the program that was chosen meanwhile.
  const passes = h("select", { onchange: () => ((chosen = { job: jobs.value, program: passes.value }), link.changed()) });
  const load = h("button", { type: "button", onclick: () => words.run(() => link.load(jobs.value, passes.value)) }, t("Load onto the mill"));
  const lift = h("input", { type: "number", min: 1, max: 200, step: "any", value: LIFT_MM, required: true, inputMode: "decimal", oninput: () => ((lift.dataset.said = "yes"), link.changed()) });
  const dry = h("button", { type: "button", onclick: () => words.run(() => link.load(jobs.value, passes.value, lift.valueAsNumber)) }, t("Load as a dry pass"));
  const about = h("p", { class: "dim" }, t("The whole program runs so much higher, with spindle and coolant off, and cuts nothing. The pass still has to be cut afterwards."));
  const dryPart = h("details", { class: "probe" }, h("summary", {}, t("Dry pass")), h("div", { class: "probe-form" }, field(t("Higher by"), lift, "mm"), dry), about);
  const reason = h("p", { class: "missing", role: "status" });
  const form = h("div", { class: "load-form" }, field(t("Job"), jobs), field(t("Program"), passes), load, dryPart, reason);
  const none = h("p", { class: "dim" }, t("No job has programs yet. "), h("a", { href: "#/new" }, t("Make one")), t(": its programs can be loaded here."));
  const node = h("section", { class: "card loading", "aria-labelledby": "loading-title" }, h("h2", { id: "loading-title" }, t("Load a program")), none, form, words.node);
  const later = h("p", { class: "notice busy", hidden: true }, shape("busy"), h("span", {}));
  node.insertBefore(later, form);
  none.hidden = form.hidden = true;
  const facts = { ready: false, jobs: 0, atWork: "", get preset() { return findPreset(); } };
  let [timer, followed, listed] = [0, "", ""]; // listed: the job whose programs are offered

  const again = () => words.run(list);

  async function list() {
    const { jobs: all } = await api.get("/v1/jobs?state=running&state=succeeded&limit=50");
    const found = await withPrograms(all);
    const wanted = findWanted().job;
    const meant = wanted && !found.some((job) => job.id === wanted) ? await findJob(wanted) : null;
    if (meant && mayBeMilled(meant)) found.push(meant); // older than the listed ones
    replace(jobs, found.map((job) => h("option", { value: job.id, selected: job.id === findWanted().job, dataset: { name: job.name } }, `${jobName(job)}, ${ago(job.created_at, api.now())}`)));
    waitFor(meant ?? (found.length ? null : all[0]));
    Object.assign(facts, { ready: true, jobs: found.length });
    none.hidden = found.length > 0 || !later.hidden;
    form.hidden = found.length === 0;
    if (found.length) await choose(jobs.value);
    else if (later.hidden) timer = setTimeout(again, NONE_MS);
    link.changed();
  }

  const findWanted = () => (chosen.job ? chosen : findFollowing(link.run));

  /** The program selected in the card; null until it is known. meant: chosen by a person, or by the last run. */
  function findPreset() {
    if (listed !== jobs.value || !passes.value) return null;
    return { job: listed, job_name: jobs.selectedOptions[0].dataset.name, program: passes.value, meant: findWanted().job === listed };
  }

  /** The job of the last run may be gone without a message; one that a person has chosen may not. */
  async function findJob(id) {
    const asked = api.get(`/v1/jobs/${id}`);
    return chosen.job === id ? asked : asked.catch(() => null);
  }

  /** The jobs are fetched again when a program has left the mill. A person's choice is settled once the program is on the mill. */
  function follow() {
    const { run } = link;
    if (run?.open && run.job === chosen.job && (!chosen.program || isProgram(run.program, chosen.program))) forgetChoice();
    const now = run === undefined || run?.open ? "" : `${run?.id}`;
    if (now && now !== followed) again();
    followed = now;
  }

  function forgetChoice() {
    chosen = {};
    const address = addressOf(link.name);
    if (location.hash.startsWith(`${address}?`)) history.replaceState(history.state, "", address);
  }

  /** A job at work is fetched again until it is done. */
  function waitFor(job) {
    clearTimeout(timer);
    later.hidden = !job || !isGoing(job);
    facts.atWork = later.hidden ? "" : percent(job.progress);
    if (later.hidden) return;
    write(later.lastChild, t`${jobName(job)} is still being worked on (${percent(job.progress)}). Its programs can be loaded once all of them have been checked.`);
    timer = setTimeout(again, AGAIN_MS);
  }

  async function choose(id) {
    const [job, done] = await Promise.all([api.get(`/v1/jobs/${id}`), finished(id)]);
    if (jobs.value !== id) return;
    listed = id;
    const wanted = findWanted();
    const meant = id === wanted.job && job.programs.find((one) => isProgram(one, wanted.program));
    const first = meant || job.programs.find((one) => !done.has(one.sha256));
    replace(passes, !first && h("option", { value: "", selected: true }, t("all are done")), job.programs.map((one) => h("option", { value: one.name, selected: one === first }, done.has(one.sha256) ? t`${one.name} (done on this mill)` : one.name)));
    link.changed();
  }

  async function finished(id) {
    const { runs } = await api.get(`/v1/runs?machine=${encodeURIComponent(link.name)}&job=${id}&limit=100`);
    return new Set(runs.filter(isCut).map((run) => run.program.sha256));
  }

  return {
    node,
    button: load,
    follow,
    close: () => clearTimeout(timer),
    /** Facts for the next step: {ready, jobs, atWork: the share that is done of the job waited for, preset}. */
    facts,
    update(nextStep) {
      const why = whyNot(link, STANDS, { besideRun: true });
      write(reason, link.machine?.mill?.state === "held" ? why : "");
      load.classList.toggle("primary", nextStep.step === "load" && !nextStep.act);
      const able = why === "" && !link.busy && findPreset() !== null;
      enable([load], able);
      if (!lift.dataset.said && link.machine) lift.valueAsNumber = Math.max(1, Math.floor(Math.min(LIFT_MM, roomToLift(link.machine))));
      enable([dry], able && lift.checkValidity());
    },
  };
}

/** The program after a run: the next pass, or the same program again if it did not finish. {job, program}, or {}. */
function findFollowing(run) {
  if (!run || run.open || (run.state === "finished" && !run.next)) return {};
  return { job: run.job, program: (run.state === "finished" ? run.next : run.program).name };
}

function isProgram({ name, number }, wanted) {
  return [name, String(number)].includes(wanted);
}

/** Jobs at work have programs for a mill once those have been checked. */
async function withPrograms(jobs) {
  const whole = await Promise.all(jobs.map((job) => (job.state === "running" ? api.get(`/v1/jobs/${job.id}`) : null)));
  return jobs.filter((job, k) => !whole[k] || mayBeMilled(whole[k]));
}
