/** The clock of the work by hand: start, pause, how much is left. Kept in the browser by job, so that a reload loses nothing. */

import { h, write } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { hours } from "../lib/words.js";

const KEPT = "causticmill-work-by-hand";
const MOST_KEPT = 50;
const EVERY_MS = 1000;
const NEW = { worked_ms: 0, since_ms: null };

/** {worked_ms, since_ms} of a job: time worked before, and the start of the present work (since 1970; null: it pauses). */
export function readClock(job) {
  try {
    const { worked_ms, since_ms } = JSON.parse(localStorage.getItem(KEPT))[job];
    if (worked_ms >= 0 && (since_ms === null || Number.isFinite(since_ms))) return { worked_ms, since_ms };
  } catch {
    // nothing kept, or nothing that can be read
  }
  return NEW;
}

/** Keep the clock of this job; the oldest ones are dropped. */
export function keepClock(job, clock) {
  let all = {};
  try {
    all = JSON.parse(localStorage.getItem(KEPT)) ?? {};
  } catch {
    // begun anew
  }
  const others = Object.entries(all).filter(([name]) => name !== job).slice(1 - MOST_KEPT);
  localStorage.setItem(KEPT, JSON.stringify(Object.fromEntries([...others, [job, clock]])));
}

/** Time worked, s. Setting the computer's clock back does not reduce it. */
export function workedSeconds({ worked_ms: worked, since_ms: since }, now_ms) {
  return (worked + (since === null ? 0 : Math.max(0, now_ms - since))) / 1000;
}

/** {node}: the clock of a job, with the minutes of its setup sheet. It stops by itself when it leaves the screen. */
export function workClock(job, minutes) {
  const whole_s = 60 * (minutes > 2 ? Math.round(minutes) : minutes); // as the sheet says it
  const left = h("strong", { role: "timer" });
  const about = h("span", { class: "dim" });
  const bar = h("progress", { max: whole_s, "aria-label": t("Work by hand so far") });
  const go = h("button", { type: "button", onclick: () => turn() });
  const anew = h("button", { type: "button", onclick: () => change(NEW) }, t("From the beginning"));
  const node = h("div", { class: "work-clock" }, h("div", { class: "row spread" }, left, h("div", { class: "row" }, anew, go)), bar, about);
  const timer = setInterval(() => (node.isConnected ? show() : clearInterval(timer)), EVERY_MS);

  function turn() {
    const clock = readClock(job), now_ms = Date.now();
    change({ worked_ms: 1000 * workedSeconds(clock, now_ms), since_ms: clock.since_ms === null ? now_ms : null });
  }

  function change(clock) {
    keepClock(job, clock);
    show();
  }

  function show() {
    const clock = readClock(job), now_ms = Date.now();
    const worked_s = workedSeconds(clock, now_ms), left_s = whole_s - worked_s, runs = clock.since_ms !== null;
    bar.value = Math.min(whole_s, worked_s);
    write(left, left_s > 0 ? t`${countdown(left_s)} left` : t("The time is over"));
    write(about, aboutWords({ worked_s, left_s, runs }, now_ms));
    write(go, runs ? t("Pause") : worked_s > 0 ? t("Go on") : t("Start the clock"));
    anew.hidden = worked_s === 0;
  }

  show();
  return { node };
}

/** Whole minutes; the last ones with seconds. */
function countdown(seconds) {
  return hours(seconds > 120 ? 60 * Math.ceil(seconds / 60) : Math.ceil(seconds));
}

function aboutWords({ worked_s, left_s, runs }, now_ms) {
  if (left_s <= 0) return t`${hours(worked_s)} worked: look whether it is done before you go on.`;
  if (runs) return t`until ${new Date(now_ms + 1000 * left_s).toLocaleTimeString(locale, { hour: "2-digit", minute: "2-digit", hour12: false })}`;
  return worked_s > 0 ? t`paused after ${hours(worked_s)}` : t("by the setup sheet");
}
