/**
 * Recovers an interrupted or stopped program: shows what happened, what must be done first and what would happen, and
 * asks a person to confirm. The plan is fetched again when the mill has changed; that moves nothing.
 */

import { api } from "../lib/api.js";
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mark } from "../lib/state.js";
import { sentence, thousands } from "../lib/words.js";
import { checklist } from "./checklist.js";
import { enable, guardedButton, refusalLine } from "./order_controls.js";
import { describe } from "./sentences.js";
import { coordinate, whyNot } from "./words.js";

const STANDS = ["idle", "alarm", "held", "check", "sleep", "door"];

export function recover(link) {
  const words = refusalLine();
  const steps = h("ol", { class: "wizard" });
  const closed = h("p", { class: "dim" }, t("Take control first."));
  const node = h("section", { class: "card recover", "aria-labelledby": "recover-title" }, h("h2", { id: "recover-title" }, t("Go on with this program")), closed, steps, words.node);
  let seen = "";
  let shown = "";
  let list = null;
  let [plan, first, raise, bars] = [null, null, "", ""];
  let [asked, answered] = [0, 0];

  async function ask() {
    const number = ++asked;
    await words.run(async () => {
      const run = link.run;
      const found = await api.get(`/v1/runs/${run.id}/recovery`);
      if (number === asked && link.run?.id === run.id) show(run, found);
    });
    if (number !== asked) return; // the mill has changed since
    answered = number;
    link.changed();
  }

  /** Recover by the plan on the screen; if the plan has changed, show the new one and ask for all ticks again. */
  async function goOn(given) {
    try {
      await link.toRun("recover", { ...given, plan: plan.plan });
    } catch (error) {
      if (error.code === "plan_changed") {
        shown = "";
        await ask();
      }
      throw error;
    }
  }

  function show(run, found) {
    const now = JSON.stringify(found);
    if (now === shown) return; // the same plan leaves the ticks as they are
    shown = now;
    plan = found;
    list = plan.ready ? checklist(run, { label: t`Go on from line ${thousands(plan.overlap_line)}`, words, act: (given) => words.run(() => goOn(given)) }) : null;
    replace(
      steps,
      step(t("What happened"), false, h("p", {}, describe(run).whole || t("The program was stopped.")), h("p", {}, t`Lines up to ${thousands(plan.executed_line)} are cut for certain.`)),
      (first = h("li", {})),
      step(t("What will happen"), false, whatHappens(plan)),
      step(t("Confirm and go on"), false, list?.node ?? [h("p", { class: "dim" }, t("When everything above is done.")), words.node]),
      h("li", { class: "give-up" }, giveUp(link, run, words)),
    );
    showFirst();
  }

  /** The first steps. A tool in the block is no obstacle to the plan, which begins by raising it, but a person at the mill must know. */
  function showFirst() {
    const again = h("button", { type: "button", onclick: ask }, t("Look again"));
    const now = step(t("Do this first"), plan.ready && !raise, needs(link, plan, { raise, words }), plan.ready ? null : again);
    first.replaceWith(now);
    first = now;
  }

  function forget() {
    if (shown) {
      replace(steps);
      node.append(words.node);
    }
    list = plan = null;
    seen = shown = raise = "";
  }

  return {
    node,
    update(nextStep) {
      const { run, machine } = link;
      const wanted = Boolean(run?.required_checks?.includes("position") && machine?.agent.reachable);
      node.hidden = !wanted;
      if (!wanted) return void forget();
      const { state, position_trusted: trusted, connected, machine_mm: place } = machine.mill;
      const mayAsk = api.who.scopes.includes("machine:run");
      closed.hidden = mayAsk;
      const now = [run.id, run.state, state, trusted, connected, state === "idle" && place, link.commands, mayAsk].join(" ");
      if (now !== seen && mayAsk && state !== "jog" && state !== "homing") ask();
      seen = now;
      bars = nextStep.bars;
      const low = bars && nextStep.words;
      if (low !== raise) {
        raise = low;
        if (plan) showFirst();
      }
      const settled = asked === answered && !link.busy; // or a tick would vanish with the plan that it belongs to
      list?.update(whyNot(link) || bars, nextStep.step === "recover", settled);
      const why = whyNot(link, STANDS, { besideRun: true });
      enable(steps.querySelectorAll(".needs button"), why === "" && !link.busy);
    },
  };
}

function step(title, done, ...content) {
  return h("li", { class: done ? "done" : "" }, h("h3", {}, title, " ", done && mark("good", t("done"))), content);
}

/** The steps that must be done before it can go on, each with its button, if there is one. */
function needs(link, plan, { raise, words }) {
  const codes = plan.needs.map(({ code }) => code);
  const own = plan.needs.filter((need) => need.code !== "zero").map((need) => [describe(need).whole, remedy(link, need.code, words, codes)]);
  const refusals = [...plan.refusals, ...(raise ? [raise] : [])].map((text) => [sentence(text), null]);
  const rows = [...own, ...zeroRow(link, plan, words), ...refusals].sort(([, one], [, other]) => Number(Boolean(other)) - Number(Boolean(one)));
  if (!rows.length) return h("p", {}, t("Nothing: the mill stands still, its position is certain, its work zero is the same."));
  return h("ul", { class: "needs" }, rows.map(([text, act]) => h("li", {}, h("p", {}, text), act)));
}

function remedy(link, code, words, codes) {
  const order = (what, body) => words.run(() => link.order(what, body));
  const home = () => link.machine.profile?.homing !== false && h("button", { type: "button", onclick: () => order("home") }, t("Home"));
  if (code === "unlock") return h("div", { class: "row" }, !codes.includes("position") && home(), guardedButton(t("Unlock"), { words: t("Is the tool free?"), yes: t("Unlock it"), act: () => order("unlock") }).node);
  if (code === "stand still") return h("div", { class: "row" }, guardedButton(t("Reset"), { words: t("The controller forgets what it still holds. From standstill it keeps its position."), yes: t("Reset it"), act: () => order("reset") }).node);
  if (code !== "position") return null;
  const trust = guardedButton(t("The position is right"), {
    words: () => t`The readout says X ${coordinate(link.machine.mill?.work_mm?.[0])}, Y ${coordinate(link.machine.mill?.work_mm?.[1])}, Z ${coordinate(link.machine.mill?.work_mm?.[2])} mm in work coordinates. Have you measured that it is so?`,
    yes: t("Yes, I have measured it"),
    act: () => order("trust-position"),
  });
  return h("div", { class: "row" }, home(), trust.node);
}

/** The work zero at which the program was cut, if it is another one now. */
function zeroRow(link, plan, words) {
  const needed = plan.needs.find((need) => need.code === "zero");
  const back = () => words.run(() => link.order("block", { text: plan.zero_back, confirm: true })); // the button states it in words
  if (plan.zero_back) return [[t("The work zero is not where the program was cut."), h("button", { type: "button", onclick: back }, t("Put the zero back"))]];
  return needed ? [[describe(needed).whole, null]] : [];
}

function whatHappens(plan) {
  const place = plan.position_mm && plan.position_mm.map((value, k) => `${"XYZ"[k]} ${coordinate(value)}`).join(", ");
  const way = place ? t`The tool rises, travels above the stock, the spindle starts, and the tool goes down slowly at ${place} mm.` : t("The program starts from its top.");
  const again = plan.recut_lines ? againWords(plan.recut_lines) : "";
  return [
    h("p", {}, `${way} ${again}`),
    plan.differences.length > 0 && h("p", {}, t("The controller's settings have changed since then:")),
    plan.differences.length > 0 && h("ul", {}, plan.differences.map((text) => h("li", {}, text.replaceAll(/-(?=\d)/g, "−")))),
    h("details", {}, h("summary", {}, t("Everything the plan says")), h("ul", {}, plan.words.map((text) => h("li", {}, text))), h("pre", { tabIndex: 0 }, plan.blocks.join("\n"))),
  ];
}

function againWords(lines) {
  if (lines === 1) return t`${lines} line before the break is cut again, so that no mark is left.`;
  return t`${lines} lines before the break are cut again, so that no mark is left.`;
}

function giveUp(link, run, words) {
  if (!run.open) return h("p", { class: "dim" }, t("Or load another program: you can go on with this one later, as long as the block stays clamped."));
  const act = () => words.run(() => link.abandonRun());
  return guardedButton(t("Give it up"), { words: t("The mill is free for another program. What was cut stays known."), yes: t("Give it up"), act }).node;
}
