/** A new job: a picture, what the wall will show of it, and everything that can be set, with an estimate at once. */

import { api } from "../lib/api.js";
import { toast } from "../lib/dialog.js";
import { h, replace, sheet } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { sentence } from "../lib/words.js";
import { keepPrediction } from "../job/eye_words.js";
import { keepDraft, take, takeDraft } from "./draft.js";
import { estimateCard, estimateLine, estimator } from "./estimate.js";
import { focusRow, specForm } from "./form.js";
import { keepOwn, MACHINE_USUAL, ownThings, startSpec } from "./own.js";
import { FIRST } from "./passes.js";
import { pictureSide } from "./picture_side.js";
import { planChoice } from "./plans.js";
import { merged, valueAt, withChange } from "./spec.js";
import { jobForm, sender } from "./submit.js";
import { priorityRow, submitBar } from "./submit_bar.js";

const FIRST_LOOK_SIDE = 1024; // pixels: enough for a first look
const CANNOT = t("Such a lens cannot be made.");

export default async function view(root, params, app) {
  let [profiles] = await Promise.all([knownProfiles(), sheet("/page/new/new.css")]);
  const start = await beginning(params);
  app.title(t("New job"));
  let page = null;
  const begin = (beginWith) => {
    page = newJob(profiles, app, withMills);
    const title = h("h1", {}, t("New job"));
    const again = h("button", { type: "button", class: "quiet", onclick: anew }, t("Start over"));
    const notice = beginWith.notice && h("p", { class: "notice" }, h("span", {}, beginWith.notice));
    replace(root, h("div", { class: "row spread title" }, title, again), notice, page.element);
    return page.begin(beginWith);
  };
  function anew() {
    const before = page.draft();
    page.stop();
    begin({});
    toast(t("Everything is as usual again."), { action: { words: t("Undo"), run: () => (page.stop(), begin(before)) } });
  }
  /** The mills of the shop have changed; name: the one to select, null for the usual one. */
  function withMills(found, name) {
    const before = page.draft();
    page.stop();
    profiles = found;
    begin({ ...before, spec: withChange(before.spec, { "machine.profile": name ?? undefined }) });
    toast(name ? t`Kept: ${name}.` : t("Taken away."));
  }
  const hide = () => page.keep();
  addEventListener("pagehide", hide);
  await begin(start);
  return { leave: () => (removeEventListener("pagehide", hide), page.leave()) };
}

/** The start of the form: another job, the picture just dropped, or the draft that was left here. */
async function beginning(params) {
  const draft = await takeDraft();
  const isReload = draft?.address === location.hash;
  if (params.from && !isReload) return { ...(await (await import("./source.js")).sourceOf(params.from, params.plan)), forMore: params.show === "more" };
  const file = take();
  return file ? { spec: draft?.spec, file } : (draft ?? {});
}

async function knownProfiles() {
  try {
    return (await api.get("/v1/profiles")).profiles;
  } catch (error) {
    if (error.status === 0) throw error;
    return [];
  }
}

/** Its contents are fetched when it is opened. */
function lateCard(title, load) {
  const card = h("details", { class: "card" }, h("summary", {}, title));
  card.addEventListener("toggle", async () => card.append(...(await load())), { once: true });
  return card;
}

/** {element, begin({spec, picture, edits, name, file, forMore}), draft(), stop(), keep(), leave()}. forMore: the person comes to see which changes show more. */
function newJob(profiles, app, withMills) {
  const now = { estimate: null, first: false, sent: false, problems: [], refused: [], why: "", look: [], forMore: false }; // problems by estimate, by refusal
  const address = location.hash;
  let coupon = null, improve = null, suggested = null; // loaded when they are needed
  const priority = priorityRow();
  const form = specForm({ profiles, last: priority, onChange: changed, planned: () => (now.estimate?.spec.passes?.length ? now.estimate.spec.passes : FIRST) });
  const plans = planChoice({ onPick: showChosen });
  const side = pictureSide({ spec: () => form.read().spec, values: form.picture, plans: plans.element, onChange: changed, onOpening: (name) => foot.ready(t`Opening ${name}…`) });
  const card = estimateCard();
  const asks = estimator({ make: (how) => estimateForm({}, how), onState: showEstimate });
  const changes = h("div");
  const foot = submitBar(submit);
  const sending = sender({ onWait: foot.wait });

  const fold = (title, rows) => h("details", { class: "card fold", "aria-label": title }, h("summary", {}, title), rows);
  const pictureFold = fold(t("Picture"), side.tools), all = fold(t("All settings"), form.settings);
  const shop = [
    lateCard(t("Your cutters"), async () => (await import("./cutters.js")).ownCutters({ onChange: () => (asks.forget(), changed()) })),
    lateCard(t("Your mills"), async () => (await import("./own_mills.js")).ownMills({ profiles, onChanged: withMills })),
    lateCard(t("Measure your mill and your finish"), async () => {
      coupon = (await import("./coupon.js")).couponPart({ take: takeChange });
      ready();
      return coupon.nodes;
    }),
  ];
  const own = ownThings({ rows: form.own, more: shop, onBlock: () => now.estimate && showChosen() });
  const settings = [pictureFold, all];
  const element = h(
    "div",
    { class: "new-job", onkeydown: leaveField },
    side.element,
    h("section", { class: "main-choices stack tight", "aria-label": t("Mill, size, time") }, own.element, h("div", { class: "card" }, form.main)),
    h("section", { class: "settings stack tight", "aria-label": t("Everything else") }, settings),
    h("div", { class: "estimate-side" }, card.element, changes),
    foot.element,
  );

  function changed() {
    const wasRefused = now.problems.length + now.refused.length > 0; // what was refused is not what the form holds now
    Object.assign(now, { problems: now.problems.filter(({ field }) => field === "image"), refused: [] });
    if (wasRefused) showProblems();
    now.forMore = false;
    side.forget();
    plans.forget();
    element.classList.toggle("stale", now.estimate !== null);
    asks.ask();
    ready();
  }

  /** Disable the button for a job that cannot be made; the reason is beside it. */
  function ready() {
    const { spec } = form.read();
    coupon?.show(valueAt(spec, "machine.profile") ?? MACHINE_USUAL);
    own.update(spec);
    foot.ready(side.fault() || now.why, now.look);
  }

  async function begin(/** @type {any} */ { spec, forMore, plan, ...start }) {
    plans.restore(plan);
    showSpec(spec ?? startSpec(profiles));
    card.show({ kind: "none" });
    ready();
    await side.begin(start);
    now.forMore = forMore;
    asks.ask();
  }

  function showSpec(spec) {
    form.show(spec);
    pictureFold.open ||= !form.isUsual("picture");
    all.open ||= ["light", "mill"].some((group) => !form.isUsual(group));
  }

  async function estimateForm(change, { exactly = false } = {}) {
    const { spec, faults } = form.read();
    if (faults.length || !side.has()) return null;
    return jobForm(await side.sent(exactly ? {} : { mostSide: FIRST_LOOK_SIDE }), JSON.stringify(withChange(spec, change)));
  }

  function takeChange({ what, values }) {
    const before = form.read().spec;
    const become = (spec) => (showSpec(spec), changed());
    become(withChange(before, values));
    toast(t`Taken: ${what}.`, { action: { words: t("Undo"), run: () => become(before) } });
  }

  function showEstimate(asked) {
    const state = asked.kind === "none" && side.has() ? { kind: "problems" } : asked;
    if (state.kind !== "known") card.show(state);
    if (state.kind !== "busy") element.classList.remove("stale");
    if (state.kind === "known") Object.assign(now, { estimate: state.estimate, first: state.first });
    if (state.kind === "known") plans.show(state.estimate, state.first);
    if (state.kind !== "busy") now.problems = state.problems ?? state.estimate?.refusals ?? [];
    if (state.kind !== "busy" && state.kind !== "none") showProblems();
    if (state.kind !== "known") improve?.stop();
    else suggest(state, now.forMore);
    if (state.kind === "known") showChosen();
    else if (state.kind !== "busy") foot.say("");
    if (state.kind !== "busy") now.forMore = false;
  }

  /** Changes that would show more; all are compared with the first look. */
  async function suggest({ estimate, after = estimate }, focus) {
    const { improvements } = await import("./improve.js");
    if (now.estimate !== estimate) return;
    improve ??= improvements({ make: estimateForm, take: takeChange });
    if (!improve.element.isConnected) replace(changes, improve.element);
    if (suggested !== after) improve.show(after);
    suggested = after;
    if (after !== estimate) improve.reconsider(estimate);
    if (focus) improve.focus();
  }

  /** Figures and wall of the plan that is chosen. */
  function showChosen() {
    const estimate = { ...now.estimate, ...plans.figures() }, { first } = now;
    card.show({ kind: "known", estimate, first });
    foot.say(estimateLine(estimate));
    side.show(estimate, first);
  }

  /** Show problems beside their fields; those without a field above the button. `focus`: a person waits for it. */
  function showProblems({ focus = false } = {}) {
    const own = form.read().faults.map(({ row, words }) => ({ field: `spec.${row.key}`, detail: words }));
    const { placed, unplaced } = form.blame([...own, ...bothOf(now.problems, now.refused)]);
    const ofPicture = unplaced.filter(({ field }) => field === "image");
    side.blame(ofPicture.map(({ detail }) => sentence(detail)).join(" "));
    foot.blame(unplaced.filter((one) => !ofPicture.includes(one)).map(({ field, detail }) => sentence(field ? `${field}: ${detail}` : detail)));
    now.why = now.problems.length ? CANNOT : "";
    now.look = placed;
    ready();
    if (focus && placed.length) focusRow(placed[0]);
    else if (focus) (ofPicture.length ? side : foot).focus();
  }

  async function submit() {
    const { spec, faults } = form.read();
    if (faults.length) return showProblems({ focus: true });
    if (!side.has() || side.fault()) return side.focus();
    if (foot.isBusy() || !(await api.need("jobs:write"))) return;
    foot.busy(true);
    try {
      const job = await sending.send(await side.sent(), merged(spec, plans.spec()), priority.read() ?? "normal");
      now.sent = true;
      keepOwn(spec);
      if (asks.settled && now.estimate.exact) keepPrediction(job.id, plans.figures().seen_db ?? now.estimate.seen_db);
      app.go(`#/jobs/${job.id}`);
    } catch (error) {
      now.refused = error.problems?.length ? error.problems : [{ field: "", detail: error.detail ?? error.message }];
      showProblems({ focus: true });
    } finally {
      foot.busy(false);
    }
  }

  function draft() {
    return { ...side.draft(), spec: form.read().spec, plan: plans.spec() };
  }

  function stop() {
    asks.stop();
    improve?.stop();
  }

  /** Keep the draft for a return, even by a reload. */
  function keep() {
    keepDraft(now.sent || !side.has() ? null : draft(), address);
  }

  function leave() {
    stop();
    keep();
  }

  return { element, begin, draft, keep, leave, stop };
}

/** The sentences of the estimate and of a refusal, each once. */
function bothOf(estimated, refused) {
  const known = new Set(estimated.map(({ detail }) => detail));
  return [...estimated, ...refused.filter(({ detail }) => !known.has(detail))];
}

/** Enter (Go on a phone's keyboard) ends a field; only the button starts a job. */
function leaveField({ key, target, isComposing }) {
  if (key === "Enter" && ["text", "number"].includes(target.type) && !isComposing) target.blur();
}
