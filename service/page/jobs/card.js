/** A job as one card of the list, kept up to date in place so that nothing flickers or loses the focus; and its picture. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { stateMark } from "../lib/state.js";
import { ago, jobName, percentUnderWay } from "../lib/words.js";

/** {element, image, pick: its tick, where many are chosen, update(job)} */
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
  let shown = "";

  function update(job) {
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
  return { element, image, pick, update };
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

/** Small pictures of jobs, fetched when they come into sight: {show(image, job), forget(image), close()}; fills image elements; `close` gives everything back. */
export function thumbnails() {
  const wanted = new WeakMap(); // image -> job
  const shown = new Map(); // image -> path of its picture
  const sight = new IntersectionObserver(
    (entries) => {
      for (const { isIntersecting, target } of entries) if (isIntersecting) fetchInto(target);
    },
    { rootMargin: "200px" },
  );

  /** Another picture of the same job takes the place of the one before once it is there. */
  async function fetchInto(image) {
    const job = wanted.get(image);
    const before = shown.get(image);
    sight.unobserve(image);
    if (!job || before === job.links.picture) return;
    shown.set(image, job.links.picture);
    try {
      image.src = await api.blob(job.links.picture);
      image.classList.add("there");
      if (before) api.release(before);
    } catch {
      forget(image); // a missing picture needs no error message
    }
  }

  function show(image, job) {
    wanted.set(image, job);
    if (job.links.picture && shown.get(image) !== job.links.picture) sight.observe(image);
  }

  function forget(image) {
    const path = shown.get(image);
    if (path) api.release(path);
    shown.delete(image);
    sight.unobserve(image);
  }

  return {
    show,
    forget,
    close() {
      sight.disconnect();
      for (const image of [...shown.keys()]) forget(image);
    },
  };
}
