/** The finish by hand: report `finishing` as a card, with its result. */
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { hours, mm } from "../lib/words.js";
import { alikeWords } from "./eye_words.js";
import { fold } from "./fold.js";
import { likenessOf } from "./figures.js";
import { workClock } from "./work_clock.js";

const WORTH_DB = 0.3;

/** {node, update(job)}; the card is shown only if the job has a finish. */
export function finishingPart() {
  const body = h("div", { class: "stack" }), node = fold("finishing", "", body), title = node.querySelector("h2");
  let shown = "";

  function update(job) {
    const report = job.report ?? {}, { finishing, as_milled: milled, as_finished: finished, rim_room: room } = report;
    const key = JSON.stringify([finishing, milled, finished, room]);
    node.hidden = !finishing;
    if (!finishing || key === shown) return;
    shown = key;
    title.textContent = t`Finishing by hand: ${finishing.title}`;
    replace(body, warnings(report).map(warning), finishing.minutes > 0 && workClock(job.id, finishing.minutes).node, howTo(finishing, room?.advice), reasons(report));
  }
  return { node, update };
}

/** Rows [what, figure] for the work and for the light on the wall. */
export function finishingRows({ finishing, as_milled: milled, as_finished: finished }) {
  const rows = [], depth = finishing.depth_um;
  if (finishing.minutes != null) rows.push([t("Time, the whole lens"), hours(60 * finishing.minutes)]);
  if (depth) rows.push([depth > 0 ? t("Comes off") : t("Is added"), mm(Math.abs(depth) / 1000)]);
  if (finishing.levelled_mm) rows.push([t("Levels"), t`waves under ${mm(finishing.levelled_mm)}`]);
  if (finishing.run_out_mm) rows.push([t("Rims"), t`mask them, or finish ${mm(finishing.run_out_mm)} beyond the lens`]);
  for (const [words, seen] of [[t("The wall as milled"), milled], [t("The wall as finished"), finished]])
    if (likenessOf(seen) !== undefined) rows.push([words, alikeWords(likenessOf(seen))]);
  if (finished?.smallest_detail_mm !== undefined) rows.push([t("Smallest detail, finished"), mm(finished.smallest_detail_mm)]);
  if (finished?.contact_share !== undefined) rows.push([t("The tool touches"), t`${(100 * finished.contact_share).toFixed(0)} % of the lens`]);
  return rows;
}

/** Sentences with the objections to this finish. */
export function warnings({ finishing, as_milled: milled, as_finished: finished }) {
  const found = [], { minutes, least_minutes: least, most_minutes: most } = finishing, inTime = (time) => hours(60 * time);
  if (finished?.psnr_db < milled?.psnr_db - WORTH_DB)
    found.push(t("This finish makes the picture worse than the mill left it: leave it out, or finish for longer."));
  if (minutes < least || minutes > most)
    found.push(t`${inTime(minutes)} is outside the known range of this process, ${inTime(least)} to ${inTime(most)} on a lens of this size. Try it on a test piece.`);
  if (!finishing.steps.length) found.push(t("This process is in no library: there are no instructions for it, its figures are your own."));
  return found;
}

function warning(words) {
  return h("p", { class: "notice warn" }, shape("warn"), h("span", {}, words));
}

/** The steps, and beside them the materials and what to watch. */
function howTo(finishing, atRims) {
  const list = (tag, sentences) => sentences.length > 0 && h(tag, {}, sentences.map((words) => h("li", {}, words)));
  const part = (words, inner) => inner && h("div", {}, h("h3", {}, words), inner);
  return h(
    "div", { class: "how-to" },
    h("div", {}, part(t("Steps"), list("ol", finishing.steps)), atRims && h("p", {}, atRims)),
    h("div", {}, part(t("You need"), list("ul", finishing.needs)), part(t("When to stop"), finishing.when_to_stop && h("p", {}, finishing.when_to_stop)), part(t("What not to do"), list("ul", finishing.donts))),
  );
}

/** Its effect on the lens and the wall, and the reasons: not needed at the bench. */
function reasons(report) {
  const { removal, law } = report.finishing;
  return h(
    "details", {},
    h("summary", {}, t("What it does to the lens")),
    h("dl", { class: "facts" }, finishingRows(report).map(([what, figure]) => h("div", {}, h("dt", {}, what), h("dd", {}, h("strong", {}, figure))))),
    removal && h("p", {}, removal),
    law && h("p", { class: "dim" }, t`Where the figures come from: ${law}`),
  );
}
