/** The time of a run and of its whole job: since when, until what time of day, how much of all programs is cut. Pure. */

import { locale, t } from "../lib/language.js";
import { isDry } from "../lib/state.js";
import { hours, percent } from "../lib/words.js";

const DAY_S = 86_400;

/** How long a run has taken, and when it will end, in words; "" if neither is known. now_ms: since 1970. */
export function runTimeWords({ started_at, time_left_s, state }, now_ms, simulated) {
  const begun_ms = Date.parse(started_at ?? "");
  const taken = begun_ms <= now_ms ? t`${hours((now_ms - begun_ms) / 1000)} since its start` : "";
  const ends = state === "running" && Number.isFinite(time_left_s) && !simulated ? t`ends about ${clock(now_ms, time_left_s)}` : "";
  return [taken, ends].filter(Boolean).join(", ");
}

function clock(now_ms, left_s) {
  const at = new Date(now_ms + 1000 * left_s);
  const time = at.toLocaleTimeString(locale, { hour: "2-digit", minute: "2-digit", hour12: false });
  return left_s > DAY_S / 2 ? `${at.toLocaleDateString(locale, { weekday: "short" })} ${time}` : time;
}

/**
 * {number, count, share, left_s} of a job with several programs, by their time; null without that, and in a dry pass.
 * passes: {file, time_s} in order, as the job's report has them.
 */
export function findWholeJob(passes, run) {
  const here = passes.findIndex(({ file }) => file === run.program.name);
  if (here < 0 || passes.length < 2 || isDry(run)) return null;
  const here_s = run.time_s || passes[here].time_s; // as the mill counts it, like what is left
  const total_s = passes.reduce((sum, one, k) => sum + (k === here ? here_s : one.time_s), 0);
  if (!(total_s > 0)) return null;
  const leftOut = new Set(run.left_out.map(({ name }) => name));
  const isLeft = ({ file }, k) => k > here || (k < here && leftOut.has(file));
  const others_s = passes.filter(isLeft).reduce((sum, one) => sum + one.time_s, 0);
  const left_s = others_s + here_s * leftOf(run);
  return { number: here + 1, count: passes.length, share: 1 - left_s / total_s, left_s };
}

/** The part of this run that is left, by time, 0 to 1. */
function leftOf({ state, time_s, time_left_s, share }) {
  if (state === "finished") return 0;
  return time_s > 0 && Number.isFinite(time_left_s) ? Math.min(1, time_left_s / time_s) : 1 - share;
}

export function wholeJobWords(whole) {
  return whole ? t`Program ${whole.number} of ${whole.count}. The whole job: ${percent(whole.share)} cut, ${hours(whole.left_s)} of milling left` : "";
}
