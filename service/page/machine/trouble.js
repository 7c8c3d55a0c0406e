/** What is wrong, in words, and the one safe thing to do next. Pure: `next.js` shows it. */

import { t } from "../lib/language.js";
import { sentence, thousands } from "../lib/words.js";
import { orderWord, RUN_STATES, describe } from "./sentences.js";
import { millWords, outOfReach } from "./words.js";

/** {kind, wrong, next, more, step} or null if nothing is; more: details on demand. step: the next step, if a button does it. */
export function troubleOf(link) {
  const { machine, run, away, gone } = link;
  if (gone) return makeTrouble("bad", sentence(gone), t("go back to the list of machines."));
  if (away) return makeTrouble("bad", t("The server does not answer."), t("to stop, use the button on the mill."), t("The mill goes on with what it has; the page shows its last report. The page goes on by itself when the server is back."));
  if (!machine) return null;
  if (machine.problem) return makeTrouble("bad", t("The file of this machine has an error."), t("correct it; this page sees it at once."), machine.problem);
  if (!machine.agent.reachable) return makeTrouble("bad", t("The server has lost this mill."), machine.remote ? t("look at the mill, then at the computer beside it.") : t("look at the mill, then start the server again."), t`${outOfReach(machine)} The mill may still be moving: stop it with its own button.`);
  return troubleOfMill(machine) ?? troubleOfRun(machine, run);
}

function makeTrouble(kind, wrong, next, more = "", step = "") {
  return { kind, wrong, next, more, step };
}

function troubleOfMill({ mill, run, profile }) {
  if (mill.state === "connecting") return makeTrouble("busy", t("Connecting to the mill."), t("wait a few seconds."));
  if (!mill.connected) return makeUnpluggedTrouble(mill, run);
  switch (mill.state) {
    case "alarm":
      return makeLockedTrouble(mill, run, profile);
    case "door":
      return makeTrouble("warn", t("The safety door is open."), t("close it, then Resume; or STOP."));
    case "tool":
      return makeTrouble("warn", t("A tool change is due."), t("change it, then Resume; or STOP."));
    case "sleep":
      return makeTrouble("warn", t("The mill is asleep, its motors are off."), t("reset it, then home it."), t("It may have been moved by hand: without homing, set the work zero again."));
    default:
      return null;
  }
}

/** One that was only switched on has nothing wrong. */
function makeLockedTrouble(mill, run, profile) {
  const { brief, whole } = millWords(mill);
  const homes = profile?.homing !== false;
  const next = homes ? t("check that the tool is free to rise, then home the mill.") : t("check that the tool is free, unlock, set the zero again.");
  return makeTrouble(mill.alarm || run ? "bad" : "", brief || t("The mill is locked."), next, t`${whole} Unlock only if you know where the tool is.`, homes ? "home" : "");
}

function makeUnpluggedTrouble(mill, run) {
  const latched = mill.latched ? t` Your ${orderWord(mill.latched)} is carried out first when the mill is back.` : "";
  const cut = run?.state === "interrupted" ? t(" Its program is interrupted; what was cut is known.") : "";
  return makeTrouble(
    "bad",
    t("The mill is not connected."),
    t("look at the mill, then at cable and power."),
    t`${millWords(mill).whole}${cut} It may still carry out what it holds, and the spindle may turn: stop it with its own button. The server finds it again by itself; that moves nothing.${latched}`,
  );
}

function troubleOfRun(machine, run) {
  if (!run?.required_checks?.includes("position")) return null;
  const [, word] = RUN_STATES[run.state] ?? ["", run.state];
  const line = run.executed_line ? t` at line ${thousands(run.executed_line)}` : "";
  const more = t`${describe(run).whole} The part is not lost, and nothing moves before you say so.`;
  return makeTrouble(run.state === "aborted" ? "warn" : "bad", t`The program was ${word}${line}.`, t("go on with it, step by step."), more, "recover");
}
