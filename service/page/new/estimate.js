/** The server's estimate of a job: requested after every change, shown in words. */

import { api } from "../lib/api.js";
import { h, replace } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { figures, freshKey, hours, mm, passName, sentence } from "../lib/words.js";
import { digest } from "./submit.js";

const CALM_MS = 250;
const EXACT_CALM_MS = 1500;
const AGAIN_MS = 5000;
const BUSY = t("Working it out…");
const COARSE = t("A first look: exact figures follow.");
const ONLY_COARSE = t("A first look: the exact figures could not be worked out.");
const FIRST = t("The first one after an installation or an update takes up to a minute; all others are quick.");
const TRIES = 3;
const SLOW_MS = 4000;
// A newer request of a tab cancels its older one, not that of another tab.
const HEADERS = { "Causticmill-Tab": freshKey() };

/**
 * {ask(), stop(), forget(), settled}. An exact answer is not requested again until `forget`. make(): the form to send, null if there is nothing to ask yet; make({exactly: true}): with the picture that a job gets, so that both share a plan. onState({kind, ...}): "none"
 * nothing to say, "busy" (`slow`: for some time now), "known" with `estimate` (`first`: a first look, an exact answer
 * follows where nothing is asked meanwhile; `after`: the first look that it replaces), "problems" with `problems`,
 * "fault" with `words`, "absent" no such service. settled: the last request has its estimate. A first look
 * comes within a second; its hours are about right, its PSNR and detail may be off by some dB.
 */
export function estimator({ make, onState }) {
  let timer = 0;
  let asking = new AbortController();
  let absent = false;
  let settled = false;
  const answers = new Map(); // by spec and picture: [first look, exact]

  function ask() {
    stop();
    settled = false;
    if (absent) return;
    asking = new AbortController();
    timer = setTimeout(() => run(asking.signal), CALM_MS);
  }

  function stop() {
    clearTimeout(timer);
    asking.abort();
  }

  async function run(signal, tries = TRIES) {
    let slow = 0;
    try {
      const form = await make();
      if (signal.aborted) return;
      if (!form) return onState({ kind: "none" });
      const key = form.get("spec") + (await digest(form.get("image")));
      if (signal.aborted) return;
      if (answers.has(key)) return showKnown(...answers.get(key));
      onState({ kind: "busy" });
      slow = setTimeout(() => signal.aborted || onState({ kind: "busy", slow: true }), SLOW_MS);
      const estimate = await api.upload("/v1/estimates", form, { headers: HEADERS, signal, quiet: true });
      if (signal.aborted) return;
      settled = true;
      onState({ kind: "known", estimate, first: !estimate.exact });
      if (!estimate.exact) timer = setTimeout(() => runExactly(signal, estimate, key), EXACT_CALM_MS);
    } catch (error) {
      if (signal.aborted) return;
      onState(describeError(error));
      if (error.status === 503 && tries > 1) timer = setTimeout(() => run(signal, tries - 1), AGAIN_MS);
    } finally {
      clearTimeout(slow);
    }
  }

  function showKnown(coarse, exact) {
    settled = true;
    onState({ kind: "known", estimate: coarse, first: true });
    onState({ kind: "known", estimate: exact, after: coarse });
  }

  async function runExactly(signal, coarse, key) {
    let estimate = coarse;
    try {
      const form = await make({ exactly: true });
      if (signal.aborted) return;
      estimate = await api.upload("/v1/estimates?exactly=true", form, { headers: HEADERS, signal, quiet: true });
      answers.set(key, [coarse, estimate]);
    } catch {
      // only the first look is available
    }
    if (!signal.aborted) onState({ kind: "known", estimate, after: coarse });
  }

  function describeError(error) {
    const problems = error.problems?.length ? error.problems : [{ field: "", detail: error.detail }];
    if (error.status === 422 || error.field === "image") return { kind: "problems", problems };
    absent = error.status === 404 || error.status === 405;
    return absent ? { kind: "absent" } : { kind: "fault", words: error.detail ?? error.message };
  }

  return {
    ask,
    stop,
    forget: () => answers.clear(),
    get settled() {
      return settled;
    },
  };
}

/** The estimate for a person; first: a first look, of which only the reliable figures are shown. */
function estimateWords(estimate, first) {
  return h(
    "div",
    { class: "stack" },
    h(
      "dl",
      { class: "figures" },
      figure(t("Machine time"), hours(3600 * estimate.hours)),
      figure(t("Smallest detail"), first ? "…" : mm(estimate.smallest_detail_mm), t("on the wall")),
      figure(t("Depth of the lens"), mm(estimate.relief_mm), t`steepest ${figures(estimate.max_slope_deg, 2)}°`),
    ),
    estimate.passes?.length > 0 &&
      h(
        "ol",
        { class: "pass-times", "aria-label": t("Passes") },
        estimate.passes.map((pass) =>
          h(
            "li",
            {},
            h("span", {}, `${passName(pass.name)}, ${toolWords(pass.tool)}`),
            h("span", { class: "number" }, hours(3600 * pass.hours)),
          ),
        ),
      ),
    (estimate.warnings ?? []).map((words) => notice("warn", words)),
  );
}

/** "ball R 3 (Ø 6 mm)", as the server writes it, without line breaks. */
function toolWords(tool) {
  return tool.replaceAll(/(?<=Ø) | (?=mm)/g, "\u00a0");
}

function notice(kind, words) {
  return h("p", { class: `notice ${kind}` }, shape(kind), h("span", {}, sentence(words)));
}

/** For the bar at the foot: one line. */
export function estimateLine({ hours: inHours, hand_min: byHand }) {
  const milling = t`About ${hours(3600 * inHours)} of milling`;
  return byHand ? t`${milling}, then ${hours(60 * byHand)} by hand` : milling;
}

function figure(name, value, more) {
  return h("div", {}, h("dt", {}, name), h("dd", {}, h("strong", {}, value), more && h("small", {}, more)));
}

/** {element, show(state)}: the card. It keeps the last figures, greyed, while new ones are worked out. */
export function estimateCard() {
  const body = h("div"), needs = h("section");
  const state = h("p", { class: "dim", role: "status" });
  const element = h(
    "section",
    { class: "card estimate", "aria-label": t("Estimate") },
    h("h2", {}, t("Estimate")),
    state,
    body,
    needs,
  );
  const words = {
    none: "",
    busy: BUSY,
    known: "",
    problems: t("None until the fields marked in red are right."),
  };
  function stateWords(result) {
    if (result.slow) return `${BUSY} ${FIRST}`;
    if (result.first) return COARSE;
    if (result.kind === "known" && !result.estimate.exact) return ONLY_COARSE;
    return words[result.kind] ?? t`No estimate now. ${result.words ?? ""}`;
  }
  function show(result) {
    element.hidden = result.kind === "absent";
    element.setAttribute("aria-busy", String(result.kind === "busy"));
    state.textContent = stateWords(result);
    state.hidden = !state.textContent;
    if (result.kind === "known") {
      replace(body, estimateWords(result.estimate, result.first));
      import("./needs.js").then(({ showNeeds }) => showNeeds(needs, result.estimate));
    } else if (result.kind !== "busy") replace(body);
    needs.hidden = !body.firstChild;
  }
  return { element, show };
}
