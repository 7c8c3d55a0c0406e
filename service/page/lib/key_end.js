/**
 * Warns long before this page's token expires, so that nobody is at a mill without one. A server renews
 * the token of a page that watches a running program, so it is asked first.
 */

import { api } from "./api.js";
import { toast } from "./dialog.js";
import { t } from "./language.js";
import { hours } from "./words.js";

const WARN_S = [2 * 3600, 1800, 600, 0]; // before the end; each warning is given once
const LOOK_MS = 60_000;

/** Watches over the end of the token. enter(): asks a person for a new code. */
export function watchKeyEnd(enter) {
  let warned = Infinity; // seconds before the end at the last warning
  let notice = { close() {} };

  async function look() {
    const before = api.who;
    if (findWarning(before, warned) === null) return;
    await api.hello().catch(() => {});
    const warn_s = before.name && !api.who.name ? 0 : findWarning(api.who, warned);
    if (warn_s === null) return;
    warned = warn_s;
    const words = inWords(warn_s && secondsLeft(api.who), await findLiveRun());
    notice.close();
    notice = toast(words, { kind: "bad", stays: true, action: { words: t("Enter a new code"), run: enter } });
  }

  api.onWho((who) => {
    if (!who.name) return; // expired; the token is kept, because it may still stop the mill
    if (secondsLeft(who) <= WARN_S[0]) return void setTimeout(look);
    notice.close();
    warned = Infinity;
  });
  setInterval(look, LOOK_MS);
}

/** Seconds for which the token of `who` is still valid; Infinity for one that does not expire. */
function secondsLeft({ expires_at: end }) {
  return end ? (Date.parse(end) - api.now()) / 1000 : Infinity;
}

/** The warning that is due now and was not given yet; null if none is. */
function findWarning(who, warned) {
  const warn_s = WARN_S.findLast((limit) => secondsLeft(who) <= limit);
  return warn_s !== undefined && warn_s < warned ? warn_s : null;
}

function inWords(left_s, run) {
  const end = left_s > 0 ? t`ends in ${hours(left_s)}` : t("has ended");
  if (run) return t`The code on this page ${end}, and ${run.program} is on ${run.machine}. Enter a new one: without it this page can only HOLD and STOP.`;
  return t`The code on this page ${end}. Enter a new one, and everything goes on.`;
}

/** {machine, program} of a program under way on any mill; null if there is none, or if that is not known. */
async function findLiveRun() {
  const { hasLiveRun } = await import("../machine/words.js");
  const { machines } = await api.get("/v1/machines", { quiet: true }).catch(() => ({ machines: [] }));
  const found = machines.find(hasLiveRun);
  return found ? { machine: found.name, program: found.run.program } : null;
}
