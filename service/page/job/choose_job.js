/** A dialog with the finished jobs to choose another one from. */
import { api } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { open } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { ago, jobName } from "../lib/words.js";

/** Resolves with the id of the chosen job, or null. */
export async function openJobs(job) {
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
