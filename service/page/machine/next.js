/**
 * The line with the next step, or with the fault and the next safe step; always in sight and of constant height, so that
 * nothing below it moves. It has the button of that step, or shows where to do it.
 */

import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { enable } from "./order_controls.js";
import { refusalOf } from "./words.js";

const REST_MS = 1000; // for which a new button ignores presses: they were meant for the button before it
const SHOWN_MS = 2000; // for which a card is framed when it is shown
const SHORT = 60; // most letters of a refusal that fit into the line
const NONE = { brief: "", whole: "" };

/** cards: {name: node} that a step may be done in; presses: {name: () => the button of a card that does it}. */
export function next(link, cards, presses) {
  const look = h("span", { class: "next-shape" });
  const trouble = h("p", { class: "trouble", role: "alert" });
  const step = h("p", { class: "step", role: "status" });
  const more = h("div", { class: "next-more", tabIndex: 0, hidden: true });
  const unfold = () => (more.hidden = !fold.open);
  const fold = h("details", { class: "next-fold", hidden: true, ontoggle: unfold }, h("summary", {}, t("More")));
  const place = h("div", { class: "next-act" });
  const [words, side] = [h("div", { class: "next-words" }, trouble, step), h("div", { class: "next-side" }, fold, place)];
  const node = h("section", { class: "next", "aria-label": t("Next step") }, look, words, side, more);
  const size = new ResizeObserver(() => document.documentElement.style.setProperty("--next", `${node.offsetHeight}px`));
  size.observe(node);
  let [shown, drawn, refusal] = ["", "", NONE];
  let fresh = 0;
  let buttons = [];
  let now = null;

  function draw(nextStep) {
    const { act, other, go } = nextStep;
    const labels = [other?.label, act?.label ?? (go ? t("Show") : "")].filter(Boolean);
    const key = labels.join("|");
    if (key !== drawn) {
      buttons = labels.map((label) => h("button", { type: "button", class: act && label === act.label ? "primary" : "", onclick: () => press(label) }, label));
      replace(place, buttons);
      fresh = Date.now() + REST_MS;
      setTimeout(() => link.changed(), REST_MS + 20);
    }
    drawn = key;
  }

  async function press(label) {
    const { act, other, go } = now;
    const answer = label === other?.label ? other : act;
    if (!answer) return void reveal(cards[go]);
    if (answer.same !== undefined) return void link.answerPlace(answer.same);
    if (answer.press) return void presses[answer.press]()?.click();
    refusal = NONE;
    try {
      await link.order(act.what, act.body);
    } catch (error) {
      refusal = refusalOf(error);
    }
    link.changed();
  }

  function say(nextStep) {
    const kind = refusal.whole ? "bad" : nextStep.kind;
    node.className = `next ${kind}`;
    replace(look, shape(kind || "wait"));
    const brief = refusal.whole.length > SHORT ? refusal.brief || t("Not carried out.") : refusal.whole;
    write(trouble, brief || nextStep.trouble?.wrong || "");
    const words = nextStep.whole ? nextStep.words : t`Next: ${nextStep.words}`;
    write(step, words);
    const all = brief === refusal.whole ? (nextStep.trouble?.more ?? "") : refusal.whole;
    write(more, all);
    fold.hidden = !all;
    if (fold.hidden) fold.open = false;
  }

  return {
    node,
    update(nextStep) {
      if (now && nextStep.step !== now.step) refusal = NONE;
      now = nextStep;
      const key = [nextStep.kind, nextStep.words, nextStep.trouble?.wrong, nextStep.trouble?.more, refusal.whole].join("|");
      if (key !== shown) say(nextStep);
      shown = key;
      draw(nextStep);
      const free = Date.now() >= fresh && !link.busy && link.machine?.mill?.state !== "jog";
      const { act } = nextStep;
      enable(buttons, !act || (free && (!act.press || presses[act.press]()?.disabled === false))); // a button that only shows something is always enabled
    },
    close() {
      size.disconnect();
      document.documentElement.style.removeProperty("--next");
    },
  };
}

/** Scroll the card into view, not under a bar, and focus its first control. */
function reveal(found) {
  const card = found?.querySelector(".checklist") ?? found; // the list that has to be ticked off
  card?.scrollIntoView({ block: "start" });
  card?.animate([{ outline: "3px solid var(--accent)" }, { outline: "3px solid transparent" }], SHOWN_MS);
  const first = card?.querySelector(".pad button:enabled") ?? card?.querySelector("button:enabled, select:enabled, input:enabled");
  first?.focus({ preventScroll: true });
}
