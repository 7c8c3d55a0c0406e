/** A job as one card of the list, kept up to date in place so that nothing flickers or loses the focus. */

import { api } from "../lib/api.js";
import { h, replace, whenSeen, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { stateMark } from "../lib/state.js";
import { ago, hours, jobName, percentUnderWay } from "../lib/words.js";

const LEAST_ID = 6; // digits: a shorter part would match too many ids

/** {element, pick: its tick for choosing many jobs, update(job), free()} */
export function jobCard(first) {
  const image = h("img", { class: "thumb", alt: "", width: 96, height: 96 });
  const name = h("span", { class: "name" });
  const state = h("span", { class: "state" });
  const bar = h("progress", { max: 1, "aria-label": t("Done") });
  const note = h("span", { class: "note dim" }), what = h("span", { class: "note" });
  const link = h(
    "a",
    { class: "card job" },
    h("span", { class: "frame" }, image),
    h("span", { class: "facts" }, name, what, state, bar, note),
  );
  const pick = h("input", { type: "checkbox", "aria-label": t`Select ${jobName(first)}` });
  const element = h("li", {}, link, h("label", { class: "pick" }, pick));
  const small = thumbnail(image);
  let shown = "";

  function update(job) {
    small.show(job.links.picture);
    link.href = `#/jobs/${job.id}`;
    write(name, jobName(job));
    name.title = job.name;
    const words = stateWords(job);
    if (words !== shown) replace(state, stateMark(job.state, words));
    shown = words;
    bar.hidden = job.state !== "running";
    bar.value = job.progress;
    write(note, noteOf(job));
    write(what, factsOf(job).map((words) => words.replaceAll(" ", "\u00a0")).join(" · "));
    element.dataset.state = job.state;
  }

  update(first);
  return { element, pick, update, free: small.free };
}

function stateWords(job) {
  if (job.cancel_requested && job.state === "running") return t("being cancelled");
  if (job.state === "running") return t`working, ${percentUnderWay(job.progress)}`;
  if (job.state === "queued" && job.queue_position)
    return job.queue_position === 1 ? t("waiting, next") : t`waiting, ${job.queue_position - 1} before it`;
  return undefined;
}

/** Size of the lens, mill, and hours on it, as far as they are known. */
function factsOf({ lens_mm: lens, machine, hours: inHours }) {
  return [lens && `${lens.join(" × ")} mm`, machine, inHours && hours(3600 * inHours)].filter(Boolean);
}

/** Whether each of these words, in small letters, is in its name, picture, mill, size or state, or begins its id. */
export function isFound(job, words) {
  const text = [job.name, stateMark(job.state).textContent, ...factsOf({ ...job, hours: null })].join(" ").toLowerCase();
  return words.every((word) => text.includes(word) || (word.length >= LEAST_ID && job.id.startsWith(word)));
}

function noteOf(job) {
  if (job.state === "failed" && job.error) return job.error.detail;
  return ago(job.ended_at ?? job.started_at ?? job.created_at, api.now());
}

/** The small picture of a job, fetched when it comes into sight: {show(path), free()}; another one takes its place once it is there. */
export function thumbnail(image) {
  let wanted = null, shown = null;
  const seen = whenSeen(image, load);

  async function load() {
    const before = shown;
    if (!wanted || wanted === before) return;
    shown = wanted;
    try {
      image.src = await api.blob(wanted);
      image.classList.add("there");
      if (before) api.release(before);
    } catch {
      shown = null; // a missing picture needs no error message
    }
  }
  return {
    show: (path) => ((wanted = path), seen.again()),
    free: () => (shown && api.release(shown), seen.end()),
  };
}
