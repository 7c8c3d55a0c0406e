/** Hours against sharpness: a slider over every useful plan, and the meaning of the selected one in words. */
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { hours, mm, passName, sentence } from "../lib/words.js";
import { alikeWords } from "./eye_words.js";
import { fold } from "./fold.js";
import { detailOfPlan, passWords } from "./figures.js";

/** {node, update(job)} */
export function planPart() {
  const slider = h("input", { type: "range", min: 0, "aria-label": t("Plans, quickest first"), oninput: () => take(slider.valueAsNumber) });
  const chosen = h("div", { class: "plan-chosen", "aria-live": "polite" });
  const why = h("details", {}, h("summary", {}, t("Why this plan was made")), h("div", { class: "plan-why" }));
  const intro = h("p", { class: "dim" }, t("There are other ways to mill this lens: more hours, sharper picture."));
  const ends = h("div", { class: "row plan-ends" }, h("span", {}, t("quicker")), slider, h("span", {}, t("sharper")));
  const node = fold("plan", t("Hours against sharpness"), intro, ends, chosen, why);
  let shown = "", job = null, plan = null, rows = [];

  function update(next) {
    job = next;
    plan = job.report?.plan;
    rows = plan?.candidates?.filter((row) => row.spec) ?? [];
    node.hidden = rows.length === 0;
    const key = JSON.stringify(plan);
    if (node.hidden || key === shown) return;
    shown = key;
    const reasons = plan.why ?? [], isSaid = (one) => reasons.some((text) => text.includes(one.tool) && text.includes(one.why));
    const left = (plan.left_out ?? []).filter((one) => !isSaid(one)).map((one) => t`Left out: ${one.tool}, ${one.why}.`);
    replace(why.lastChild, [...reasons, ...left].map((text) => h("p", {}, text)));
    slider.max = rows.length - 1;
    slider.value = plan.chosen;
    take(plan.chosen);
  }
  function take(k) {
    slider.setAttribute("aria-valuetext", `${hours(rows[k].hours * 3600)}, ${alikeWords(rows[k].seen_db)}`);
    replace(chosen, inWords(job, rows[k], k, plan.chosen));
  }
  return { node, update };
}

function inWords(job, row, k, made) {
  const passes = row.spec.passes ?? [], own = k === made;
  return [
    h("h3", {}, t`${hours(row.hours * 3600)}: details under ${mm(detailOfPlan(job.spec, row))} will blur`),
    h("p", {}, t`On the wall: ${alikeWords(row.seen_db)} `, h("small", { class: "dim" }, `(${row.psnr_db.toFixed(1)} dB)`)),
    row.warning && h("p", { class: "notice warn" }, shape("warn"), h("span", {}, sentence(row.warning))),
    h("ol", { class: "plan-passes" }, passes.map((pass, n) => passRow(pass, row.hours_by_pass?.[n]))),
    own
      ? h("p", { class: "dim" }, t("This is the plan of this job, predicted before the programs were written; what they will do is under “What to expect”."))
      : h("a", { class: "button primary", href: `#/new?from=${job.id}&plan=${k}` }, t("Make this job")),
  ];
}

function passRow(pass, inHours) {
  return h("li", {}, h("strong", {}, passName(pass.name)), ": ", passWords(pass), inHours ? `, ${hours(inHours * 3600)}` : "");
}
