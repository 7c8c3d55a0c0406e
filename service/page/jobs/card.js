/** A job as one card of the list, kept up to date in place so that nothing flickers or loses the focus. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { stateMark } from "../lib/state.js";
import { whenSeen } from "../lib/when_seen.js";
import { ago, jobName, percentUnderWay } from "../lib/words.js";

/** {element, pick: its tick, where many are chosen, update(job), free()} */
export function jobCard(first) {
  const image = h("img", { class: "thumb", alt: "", width: 96, height: 96 });
  const name = h("span", { class: "name" });
  const state = h("span", { class: "state" });
  const bar = h("progress", { max: 1, "aria-label": t("Done") });
  const note = h("span", { class: "note dim" });
  const link = h(
    "a",
    { class: "card job" },
    h("span", { class: "frame" }, image),
    h("span", { class: "facts" }, name, state, bar, note),
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

function noteOf(job) {
  if (job.state === "failed" && job.error) return job.error.detail;
  return ago(job.ended_at ?? job.started_at ?? job.created_at, api.now());
}

/** The small picture of a job, fetched when it comes into sight: {show(path), free()}; another one takes its place once it is there. */
function thumbnail(image) {
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
