/** A new job: a picture, what the wall will show of it, and everything that can be set, with an estimate at once. */

import { api } from "../lib/api.js";
import { toast } from "../lib/dialog.js";
import { freshId, h, replace, sheet, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { sentence } from "../lib/words.js";
import { keepPrediction } from "../job/prediction.js";
import { couponPart } from "./coupon.js";
import { keepDraft, take, takeDraft } from "./draft.js";
import { estimateCard, estimateLine, estimator } from "./estimate.js";
import { focusRow, specForm } from "./form.js";
import { START, usualOf } from "./fields.js";
import { improvements, withChange } from "./improve.js";
import { firstProfile } from "./machines.js";
import { FIRST } from "./passes.js";
import { pictureSide } from "./picture_side.js";
import { priorityRow } from "./priority.js";
import { put, valueAt } from "./spec.js";
import { jobForm, sender } from "./submit.js";

const MACHINE_USUAL = usualOf("machine.profile");
const ESTIMATE_SIDE = 1024; // pixels: enough for what it is asked for
const OWN = "causticmill-own"; // of this browser
const OWN_KEYS = ["machine.profile", "stock.thickness_mm", "stock.material", "finish.process", "optics.light", "optics.throw_mm"];
const MAKE = t("Make the lens");
const NO_PICTURE = t("Choose a picture first.");
const CANNOT = t("Such a lens cannot be made.");
const MOST_NAMED = 3; // problems that are named beside the button
const WAITS = t("The server does not answer. The job is sent as soon as it does; leave this page open.");

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

/** The usual job, for what the person had in the last one: mill, block, finish, lamp, wall. */
function startSpec(profiles) {
  const own = JSON.parse(localStorage.getItem(OWN) ?? "{}"), isKnown = profiles.some(({ name }) => name === own["machine.profile"]);
  const spec = structuredClone({ ...START, machine: { profile: firstProfile(profiles, MACHINE_USUAL) } });
  for (const [key, value] of Object.entries(own)) if (isKnown || key !== "machine.profile") put(spec, key, value);
  return spec;
}

/** Keep them in this browser; of a job with passes of its own only what does not depend on the way of planning. */
function keepOwn(spec) {
  const keys = OWN_KEYS.filter((key) => (key !== "finish.process" || spec.preset === START.preset) && !valueAt(spec, `${key}.profile`));
  localStorage.setItem(OWN, JSON.stringify(Object.fromEntries(keys.map((key) => [key, valueAt(spec, key)]))));
}

/** All keys under their titles, and a field that leaves only those whose words or key hold what is typed. */
function allSettings(settings) {
  const parts = settings.map(([title, element]) => h("section", {}, h("h3", {}, title), element));
  const find = () => {
    const wanted = search.value.trim().toLowerCase(), lacks = (one) => !`${one.dataset.key ?? ""} ${one.textContent}`.toLowerCase().includes(wanted);
    for (const part of parts) {
      const rows = [...part.querySelectorAll(".fields > .field")];
      for (const one of rows) one.classList.toggle("unfound", lacks(one));
      part.classList.toggle("unfound", rows.length ? rows.every(lacks) : lacks(part));
    }
  };
  const search = h("input", { type: "search", placeholder: t("Search"), "aria-label": t("Search all settings"), oninput: find });
  return h("div", { class: "stack expert" }, search, parts);
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

/** {element, begin({spec, picture, edits, name, file, forMore}), draft(), stop(), keep(), leave()}. forMore: a person comes to see what shows more. */
function newJob(profiles, app, withMills) {
  const now = { estimate: null, sent: false, problems: [], refused: [], why: "", look: [], forMore: false }; // problems by estimate, by refusal
  const address = location.hash;
  const form = specForm({ profiles, onChange: changed, planned: () => (now.estimate?.spec.passes?.length ? now.estimate.spec.passes : FIRST) });
  const side = pictureSide({ spec: () => form.read().spec, values: form.picture, onChange: changed, onOpening: (name) => foot.ready(t`Opening ${name}…`) });
  const priority = priorityRow();
  const card = estimateCard();
  const asks = estimator({ make: estimateForm, onState: showEstimate });
  const coupon = couponPart({ take: takeChange });
  const improve = improvements({ make: estimateForm, take: takeChange });
  const foot = submitBar(submit);
  const sending = sender({ onWait: foot.wait });

  const fold = (title, rows) => h("details", { class: "card fold", "aria-label": title }, h("summary", {}, title), rows);
  const pictureFold = fold(t("Picture"), side.tools), all = fold(t("All settings"), allSettings([...form.settings, [t("Queue"), priority.element]]));
  const shop = [
    lateCard(t("Your cutters"), async () => (await import("./cutters.js")).ownCutters({ onChange: () => (asks.forget(), changed()) })),
    lateCard(t("Your mills"), async () => (await import("./own_mills.js")).ownMills({ profiles, onChanged: withMills })),
    coupon.element,
  ];
  const settings = [pictureFold, h("div", { class: "grid shop" }, shop), all];
  const element = h(
    "div",
    { class: "new-job", onkeydown: leaveField },
    side.element,
    h("section", { class: "card main-choices", "aria-label": t("Mill, size, time") }, form.main),
    h("section", { class: "settings stack tight", "aria-label": t("Everything else") }, settings),
    h("div", { class: "estimate-side" }, card.element, improve.element),
    foot.element,
  );

  function changed() {
    now.refused = []; // the form differs from what was sent
    now.forMore = false;
    side.forget();
    element.classList.toggle("stale", now.estimate !== null);
    asks.ask();
    ready();
  }

  /** Disable the button for a job that cannot be made; the reason is beside it. */
  function ready() {
    coupon.show(valueAt(form.read().spec, "machine.profile") ?? MACHINE_USUAL);
    foot.ready(!side.has() ? NO_PICTURE : side.fault() || now.why, now.look);
  }

  async function begin(/** @type {any} */ { spec, forMore, ...start }) {
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
    all.open ||= !form.isUsual("lens", "light", "mill");
  }

  async function estimateForm(change = {}) {
    const { spec, faults } = form.read();
    if (faults.length || !side.has()) return null;
    return jobForm(await side.sent({ mostSide: ESTIMATE_SIDE }), JSON.stringify(withChange(spec, change)));
  }

  function takeChange({ what, values }) {
    const before = form.read().spec;
    const become = (spec) => (showSpec(spec), changed());
    become(withChange(before, values));
    toast(t`Taken: ${what}.`, { action: { words: t("Undo"), run: () => become(before) } });
  }

  function showEstimate(asked) {
    const state = asked.kind === "none" && side.has() ? { kind: "problems" } : asked;
    card.show(state);
    if (state.kind !== "busy") element.classList.remove("stale");
    if (state.kind === "known") now.estimate = state.estimate;
    if (state.kind !== "busy") now.problems = state.problems ?? state.estimate?.refusals ?? [];
    if (state.kind !== "busy" && state.kind !== "none") showProblems();
    if (state.kind !== "known") improve.stop();
    else if (state.after) improve.reconsider(state.estimate);
    else improve.show(state.estimate);
    if (state.kind !== "busy") foot.say(state.kind === "known" ? estimateLine(state.estimate, state.first) : "");
    if (state.kind === "known") side.show(state.estimate, state.first);
    if (state.kind === "known" && now.forMore) improve.focus();
    if (state.kind !== "busy") now.forMore = false;
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
      const job = await sending.send(await side.sent(), spec, priority.read());
      now.sent = true;
      keepOwn(spec);
      if (asks.settled && now.estimate.exact) keepPrediction(job.id, now.estimate.seen_db);
      app.go(`#/jobs/${job.id}`);
    } catch (error) {
      now.refused = error.problems?.length ? error.problems : [{ field: "", detail: error.detail ?? error.message }];
      showProblems({ focus: true });
    } finally {
      foot.busy(false);
    }
  }

  function draft() {
    return { ...side.draft(), spec: form.read().spec };
  }

  function stop() {
    asks.stop();
    improve.stop();
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

/** Enter, on a phone the keyboard's Go, ends a field; a job is begun by its button alone. */
function leaveField({ key, target, isComposing }) {
  if (key === "Enter" && ["text", "number"].includes(target.type) && !isComposing) target.blur();
}

/** The bar at the foot: the estimate in one line, the button, and the reason if it is disabled. */
function submitBar(onclick) {
  const line = h("p", { class: "line" });
  const why = h("p", { class: "line why row", id: freshId("why") });
  const button = h("button", { type: "button", class: "primary big", "aria-describedby": why.id, onclick }, MAKE);
  const waits = h("p", { class: "notice warn", role: "status", hidden: true }, shape("warn"), h("span", {}, WAITS));
  const faults = h("div", { class: "stack tight", role: "alert" });
  const notice = (words) => h("p", { class: "notice bad" }, shape("bad"), h("span", {}, words));
  const now = { sending: false, why: "", look: [] };
  let listed = [];
  const name = (row) => h("button", { type: "button", class: "quiet", onclick: () => focusRow(row) }, row.field.label);
  function update() {
    button.setAttribute("aria-disabled", String(now.sending));
    button.disabled = now.why !== "" && !now.sending;
    write(button, now.sending ? t("Sending…") : MAKE);
    line.hidden = Boolean(now.why || now.look.length);
    why.hidden = !line.hidden;
    const more = now.look.length - MOST_NAMED, said = [now.why, ...now.look];
    if (said.length === listed.length && said.every((one, k) => one === listed[k])) return; // the focus stays
    listed = said;
    const names = now.look.slice(0, MOST_NAMED).map(name);
    replace(why, now.why, names.length > 0 && [" ", t("Look at:"), names, more > 0 && t`+ ${more} more`]);
  }
  return {
    element: h("div", { class: "submit-bar" }, faults, waits, h("div", { class: "row spread" }, line, why, button)),
    say: (words) => write(line, words),
    blame: (details) => replace(faults, details.map(notice)),
    wait: (waiting) => (waits.hidden = !waiting),
    isBusy: () => now.sending,
    busy: (sending) => ((now.sending = sending), update()),
    /** why: what is missing before it can be sent, "" nothing; look: the rows to look at. */
    ready: (why, look = []) => (Object.assign(now, { why, look }), update()),
    focus: () => button.focus(),
  };
}
