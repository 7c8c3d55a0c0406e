/** Single changes of a job that show more of its picture: the result of each, and a button that applies it. */

import { api } from "../lib/api.js";
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { freshKey, hours, sentence } from "../lib/words.js";
import { alikeWords, isHard } from "../job/eye_words.js";

const WORTH_DB = 1;
// A separate estimator: a request here does not cancel the estimate of the job itself.
const HEADERS = { "Causticmill-Tab": freshKey() };
const NONE = t("No single change of these settings shows clearly more.");

/**
 * {element, show(estimate), focus(), reconsider(exact), stop()}. make(values): the form that asks for the job with a change; take(change): a person
 * wants it. Each has a picture of the wall. The changes of a picture that is hard to recognise are estimated at once,
 * others when a person asks. The first look at a change is compared with the first look at the job itself, and its gain
 * is added to the job's exact estimate.
 */
export function improvements({ make, take }) {
  const list = h("ul", { class: "changes" });
  const state = h("p", { class: "dim", role: "status" });
  const button = h("button", { type: "button", class: "quiet", onclick: () => ask(now.estimate) }, t("What would show more?"));
  const title = h("h2", {}, t("What would show more"));
  const element = h("section", { class: "card improvements", "aria-label": t("What would show more"), tabIndex: -1, hidden: true }, title, button, state, list);
  const now = { estimate: null, exact: null, found: [], asking: new AbortController() };

  function show(estimate) {
    stop();
    Object.assign(now, { estimate, exact: estimate, found: [] });
    replace(list);
    state.textContent = "";
    element.hidden = !Number.isFinite(estimate.psnr_db) || !estimate.changes?.length;
    if (!element.hidden && isHard(estimate.seen_db)) ask(estimate);
    else fold(true);
  }

  /** Move the focus here: a person asked for it. */
  function focus() {
    if (element.hidden) return;
    if (!button.hidden) ask(now.estimate);
    element.scrollIntoView();
    element.focus({ preventScroll: true });
  }

  /** A more exact answer for the job that is shown. */
  function reconsider(exact) {
    now.exact = exact;
    replace(list, now.found.map(line));
    if (!element.hidden && !button.hidden && isHard(exact.seen_db)) ask(now.estimate);
  }

  function fold(folded) {
    button.hidden = !folded;
    title.hidden = folded;
  }

  function stop() {
    now.asking.abort();
    element.hidden = true;
  }

  async function ask(estimate) {
    now.asking = new AbortController();
    const { signal } = now.asking;
    fold(false);
    const { found } = now;
    for (const [number, change] of estimate.changes.entries()) {
      state.textContent = t`Working it out: ${number + 1} of ${estimate.changes.length}…`;
      const seen = await estimateChange(change, signal);
      if (signal.aborted) return;
      if (!seen || seen.refusals?.length || !(seen.psnr_db >= estimate.psnr_db + WORTH_DB)) continue;
      found.push([change, seen]);
      found.sort(([, one], [, other]) => other.psnr_db - one.psnr_db);
      replace(list, found.map(line));
    }
    state.textContent = found.length ? "" : NONE;
  }

  async function estimateChange(change, signal) {
    try {
      return await api.upload("/v1/estimates", await make(change.values), { headers: HEADERS, signal, quiet: true });
    } catch {
      return null; // a change whose estimate fails is left out
    }
  }

  const line = ([change, seen]) =>
    h(
      "li",
      {},
      h("button", { type: "button", onclick: () => take(change) }, h("img", { class: "outcome", src: seen.wall, alt: "" }), h("span", {}, sentence(change.what).replace(/[.。]$/, ""))),
      h("small", {}, [alikeWords(now.exact.seen_db + seen.seen_db - now.estimate.seen_db), hours(3600 * seen.hours)].join(", ")),
    );

  return { element, show, focus, reconsider, stop };
}
