/** Plans side by side as walls: the picture of each, its time on the mill and by hand, and its likeness. */

import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { hours } from "../lib/words.js";
import { alikeWords } from "../job/eye_words.js";
import { same } from "./spec.js";

const WAITS = [null, null, null]; // places for the plans that an exact estimate brings

/**
 * {element, show(estimate, first), forget(), restore(spec), figures(), spec()}. figures: the chosen plan's own, in
 * place of the estimate's; spec: the values that select it, null for the planner's own choice. onPick(): a person chose
 * another plan.
 */
export function planChoice({ onPick }) {
  const list = h("div", { class: "walls" });
  const element = h("fieldset", { class: "plans" }, h("legend", {}, t("Plans to choose from")), list);
  const now = { plans: [], taken: null, wanted: null };

  function show({ plans = [], planned }, first) {
    if (first) return draw(planned ? WAITS : []);
    now.plans = plans;
    now.taken = plans.find(({ spec }) => same(spec, now.wanted)) ?? plans.find(({ is_chosen: own }) => own) ?? null;
    draw(plans);
  }

  function draw(rows) {
    element.hidden = rows.length < 2;
    element.disabled = rows === WAITS;
    if (rows !== WAITS || !list.childElementCount) replace(list, rows.map((plan, k) => tile(plan, rows.length - 1 - k)));
  }

  /** fromEnd: 0 for the last plan. */
  function tile(plan, fromEnd) {
    const take = () => ((now.taken = plan), (now.wanted = valuesOf(plan)), onPick());
    const input = h("input", { type: "radio", name: "plan", checked: plan !== null && plan === now.taken, onchange: take });
    if (!plan) return h("label", {}, input, h("span", { class: "wall-place" }), h("strong", {}, "…"), h("small", {}, t("being planned")));
    const name = plan.is_chosen ? t("recommended") : fromEnd ? t("quickest") : t("sharpest");
    const work = [plan.hand_min !== null && t`then ${hours(60 * plan.hand_min)} by hand`, alikeWords(plan.seen_db)].filter(Boolean);
    return h("label", {}, input, h("img", { src: plan.wall, alt: "" }), h("strong", {}, hours(3600 * plan.hours)), h("small", {}, name), work.map((words) => h("small", {}, words)));
  }

  draw(WAITS); // their place is kept from the start
  return {
    element,
    show,
    /** The settings have changed: these plans no longer belong to them. */
    forget() {
      Object.assign(now, { plans: [], taken: null, wanted: null });
      element.disabled = true;
    },
    /** Choose the plan of these values once it is known. */
    restore: (spec) => (now.wanted = spec ?? null),
    figures() {
      if (!now.taken) return {};
      const { is_chosen: own, spec, ...figures } = now.taken, byHand = { hand_min: figures.hand_min, finish: spec.finish };
      return own ? byHand : { ...figures, ...byHand };
    },
    spec: () => now.taken && valuesOf(now.taken),
  };
}

function valuesOf({ is_chosen: own, spec }) {
  return own ? null : spec;
}
