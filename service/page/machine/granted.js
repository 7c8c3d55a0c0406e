/**
 * Sends an order to a mill under a grant that it asks for at the press. The mill's own computer accepts the order only
 * within seconds of the grant, and not after a stop; if the grant comes too late, the order is not sent.
 */

import { api } from "../lib/api.js";
import { t } from "../lib/language.js";

const WITHIN_MS = 2000;
const HEADER = "Causticmill-Grant";
const LATE = t`Not sent: the mill did not answer within ${WITHIN_MS / 1000} s. Look at it, then press again.`;

/** The order was not sent. */
export class NotSentError extends Error {}

/**
 * Send an order now, once or never: NotSentError, or ProblemError if it was refused.
 * machine: its path; stops: the count of stops that the person could know; headers: who has control.
 */
export async function sendGranted({ machine, stops, headers }, path, body) {
  const elapsed_ms = stopwatch();
  const grant = await askGrant(`${machine}/grants`, { stops }, headers, WITHIN_MS - elapsed_ms());
  if (!grant || elapsed_ms() > WITHIN_MS) throw new NotSentError(LATE);
  return api.post(path, body, { headers: { ...headers, [HEADER]: grant } });
}

/** The grant; "" if none came in time. */
async function askGrant(path, body, headers, left_ms) {
  const timeout = AbortSignal.timeout(Math.max(0, left_ms));
  try {
    return (await api.post(path, body, { headers, signal: timeout, timeout_ms: 0 })).grant;
  } catch (error) {
    if (timeout.aborted) return "";
    throw error;
  }
}

/**
 * Time since the press, ms, by the clock that has advanced more: one of them may stop while the computer sleeps, and
 * the other may be set. A press that had to wait for a busy page is as old as the press.
 */
export function stopwatch() {
  const pressed = globalThis.event?.timeStamp ?? performance.now();
  const wall = Date.now() - (performance.now() - pressed);
  return () => Math.max(performance.now() - pressed, Date.now() - wall);
}
