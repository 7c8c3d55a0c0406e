/**
 * The page's only table of sentences for the codes of server and mill. Values are inserted only here, so that
 * another language is another table. A test holds its keys against the codes of the sources (tests/page/test_words.py).
 */

import { t } from "../lib/language.js";
import { capital, sentence } from "../lib/words.js";

/** State of a mill: [kind, word]. */
export const STATES = {
  disconnected: ["bad", t("not connected")],
  connecting: ["busy", t("connecting")],
  idle: ["good", t("idle")],
  run: ["busy", t("running")],
  holding: ["warn", t("stopping")],
  held: ["warn", t("held")],
  jog: ["busy", t("jogging")],
  homing: ["busy", t("homing")],
  door: ["warn", t("door open")],
  check: ["warn", t("check mode, nothing moves")],
  alarm: ["bad", t("locked")],
  sleep: ["off", t("asleep")],
  tool: ["warn", t("waits for a tool change")],
};

/** State of a run: [kind, word]. */
export const RUN_STATES = {
  preparing: ["busy", t("being loaded")],
  refused: ["bad", t("refused")],
  lost: ["bad", t("lost")],
  parked: ["wait", t("waits for your start")],
  running: ["busy", t("running")],
  holding: ["warn", t("stopping")],
  held: ["warn", t("held")],
  stopping: ["warn", t("being stopped")],
  interrupted: ["bad", t("interrupted")],
  recovering: ["busy", t("going back to its place")],
  finished: ["good", t("finished")],
  aborted: ["off", t("stopped")],
};

const mill = (state) => STATES[state]?.[1] ?? state;
const program = (state) => RUN_STATES[state]?.[1] ?? state;

/** Words for an order, by its name in server and log. */
const ORDERS = {
  reset: t("reset"),
  unlock: t("unlock"),
  home: t("home"),
  jog: t("jog"),
  probe: t("probe"),
  "probe-corner": t("probe the corner"),
  zero: t("zero"),
  "trust-position": t("trust-position"),
  override: t("override"),
  check: t("check"),
  block: t("block"),
  settings: t("settings"),
  start: t("start"),
  resume: t("resume"),
  recover: t("recover"),
  hold: t("hold"),
  abort: t("abort"),
};

/** The word for an order. */
export const orderWord = (order) => ORDERS[order] ?? order;

/** By number of an alarm: what has happened, and what to do about it. */
const ALARMS = {
  1: [t("hard limit hit"), t("position lost: free the axis, home again")],
  2: [t("move would leave the travel"), t("position kept: unlock, check zero and program")],
  3: [t("reset while moving"), t("position lost: home or set the zero again")],
  4: [t("probe was already touching"), t("or not connected: check the probe")],
  5: [t("probe did not touch within its travel"), t("move closer and repeat")],
  6: [t("homing stopped by a reset"), t("home again")],
  7: [t("homing stopped by the safety door"), t("close it, home again")],
  8: [t("homing could not leave the switch"), t("check switch, wiring and $27")],
  9: [t("homing did not find the switch"), t("check switch, wiring and travel")],
  10: [t("homing of a second motor failed"), t("or emergency stop: release it, reset, home again")],
  11: [t("homing required"), t("home the mill")],
  12: [t("a limit switch is touching"), t("move off it")],
  13: [t("probe protection tripped"), t("check the probe")],
  14: [t("spindle did not reach its speed"), t("check the spindle")],
  15: [t("homing of the second motor failed"), t("check both switches")],
  16: [t("power-on self test failed"), t("check the controller")],
  17: [t("motor fault"), t("check drives and power")],
};

const alarmWords = (number) => ALARMS[number]?.join(", ") ?? t`alarm ${number}, see the manual of its controller`;
const lockedWords = (number) => (number in ALARMS ? t`Locked: ${ALARMS[number][0]}.` : t("The mill is locked."));

const DOUBTS = {
  restarted: t("The controller has restarted since the run stopped, its position is lost"),
  unconfirmed: t("Nobody had confirmed the position when the run stopped"),
  settings: t("Settings that define the position have changed since the run stopped"),
  unseen: t("The controller may have restarted while the link was lost"),
};
const POSITION = t("home the mill, or touch off again at the same points of the part (zero of X, Y, Z), or, if you know that the position is right, confirm it.");

const NO_ANSWER = t("The computer beside the mill does not answer.");
const unansweredWords = ({ seconds }) => (seconds ? t`The computer beside the mill did not answer within ${seconds} s.` : NO_ANSWER);

const fault = (cause) => ({ detail }) => sentence(`${cause}: ${detail}`);

/** By code: a sentence, or a function of the values that makes it; {brief, whole} if a line has no room for the whole, with `parts`: the folded rest. */
const SENTENCES = {
  // an order that was refused
  grant_missing: t("Not carried out: the mill had not granted this order. Press again."),
  grant_unknown: t("Not carried out: the mill no longer knows this order. Look at the mill, then press again."),
  grant_expired: t("Not carried out: it reached the mill too late. Look at the mill, then press again."),
  grant_stopped: t("Not carried out: the mill was stopped after you pressed. Look at the mill, then press again."),
  grant_lease: t("Not carried out: control of the mill has changed since you pressed."),
  control_held: ({ operator }) => t`${operator ?? t("Somebody else")} has control: ask them, or take over.`,
  control_lost: t("Control has ended: the server heard nothing from you for too long. Take control again."),
  control_needed: t("Nobody has control: take control first."),
  plan_changed: t("Not carried out: the way to go on has changed since it was shown. Read it again, then tick again."),
  setup_changed: t("Not started: zero or position have changed since you looked. Compare the readout with the block, then tick again."),
  owner_ended: ({ reason }) => t`The computer beside the mill has given the mill up${reason && ` (${reason})`}: start causticmill mill on it again.`,
  owner_silent: ({ seconds, taken_back: back }) => t`The computer beside the mill gave no answer within ${seconds} s, ${back ? t("the order was taken back") : t("the order may still be carried out")}; use the mill's own stop button.`,
  no_block: ({ text }) => t`'${text}' is not a line of G-code.`,
  mill_state: ({ state }) => t`Not carried out: the mill is ${mill(state)}.`,
  run_state: ({ state }) => t`Not carried out. The state of the program: ${program(state)}.`,
  run_live: t("Not carried out: another program is on the mill."),
  run_unstarted: t("Not carried out: this program was never started. Load it again."),
  travel: ({ detail }) => {
    const brief = t("Not started: from this zero the program leaves the travel. Set the zero where it fits, or home the mill if its position is wrong.");
    const parts = detail.split("\n").map(sentence);
    return { brief, whole: [brief, ...parts].join(" "), parts };
  },
  confirm: ({ effect }) => sentence(effect),
  order_uncertain: ({ order }) => ({
    brief: t("Look at the mill: the order may have arrived."),
    whole: t`The computer beside the mill does not answer; whether the ${orderWord(order)} arrived is not known: LOOK AT THE MILL, it is not sent again.`,
  }),
  stop_uncertain: unansweredWords,
  order_without_effect: ({ order, state }) => ({
    brief: NO_ANSWER,
    whole: t`The computer beside the mill does not answer; the ${orderWord(order)} has not taken effect so far. The state of the program: ${program(state)}.`,
  }),

  // the link to the mill
  agent_absent: NO_ANSWER,
  agent_unreached: NO_ANSWER,
  agent_key_unusable: ({ reason }) => sentence(t`The key of the computer beside the mill cannot be used: ${reason}`),
  agent_key_refused: t("The computer beside the mill does not take this server's key."),
  agent_other: t("Another program answers in place of the computer beside the mill."),
  agent_silent: t("The connection to the computer beside the mill has ended."),
  agent_wrong: t("The computer beside the mill gave an answer that makes no sense: does it run the same version of causticmill as this server?"),
  agent_fault: ({ status, reason }) => sentence(t`The computer beside the mill answered ${status}: ${reason}`),

  // why a program is in its state
  owner_lost: ({ state }) => t`The computer beside the mill stopped while the program was ${program(state)}.`,
  aborted: t("Aborted by the operator."),
  taken_back: t("Taken back before its start."),
  run_lost: t("The computer beside the mill no longer knows this program."),
  run_given_up: t("Given up."),
  run_unknown: t("No computer beside a mill knows this program."),
  "error reply": fault(t("Error reply")),
  alarm: ({ alarm, detail }) => sentence(t`Alarm: ${alarm ? alarmWords(alarm) : detail}`),
  "controller restarted": fault(t("Controller restarted")),
  "port lost": fault(t("Port lost")),
  "replies do not match lines": fault(t("Replies do not match lines")),
  "garbled reply": fault(t("Garbled reply")),
  "no reply in time": fault(t("No reply in time")),
  "position off the programmed path": fault(t("Position off the programmed path")),
  "echo differs from what was sent": fault(t("Echo differs from what was sent")),
  "program changed on disk": fault(t("Program changed on disk")),
  "device reports a fault": fault(t("Device reports a fault")),

  // why a mill is in its state
  locked: ({ alarm }) => ({ brief: lockedWords(alarm), whole: `${capital(alarmWords(alarm))}.` }),
  locked_until_reset: ({ alarm }) => ({ brief: lockedWords(alarm), whole: t`${capital(alarmWords(alarm))}; waiting until the controller accepts a reset.` }),
  silent: {
    brief: t("The mill does not answer."),
    whole: t("Nothing answers '?'. After a limit alarm a controller accepts nothing but a reset, and while it homes it does not answer either: look at the mill; if it stands still, send a reset."),
  },

  // needs that must be met first
  connect: ({ state }) => (state === "idle" ? t("The mill has not reported its position yet: wait a second.") : t`The mill is ${mill(state)}: connect it; connecting moves nothing.`),
  wait: ({ state }) => t`The mill is ${mill(state)}: wait until that has ended, or hold it.`,
  "stand still": ({ state }) => t`The mill is ${mill(state)} and may hold unfinished blocks: reset it, which clears them and, from standstill, keeps the position.`,
  unlock: t("The mill is locked: home it, or unlock it."),
  position: ({ doubt, settings }) =>
    settings
      ? t`Settings that define the position have changed since the part was cut (${settings}): put them back and home the mill, or, if you know that the position is right, confirm it.`
      : `${DOUBTS[doubt]}: ${POSITION}`,
  zero: t("The work zero is not where the program was cut, and where that was is not certain. Touch off and set X, Y and Z again."),

  // the log: no sentences
  hold: t("HOLD"),
  abort: t("STOP"),
  "jog-cancel": t("End of a jog"),
  order_taken: ({ order }) => t`${orderWord(order)}: taken`,
  order_refused: (refusal) => t`${orderWord(refusal.order)}: refused. ${describe(refusal).whole}`,
  settings_read: t("Read settings: done"),
  run_parked: ({ name }) => t`${name}: waits for your start`,
  run_left: ({ name, state }) => t`${name}: interrupted (the computer beside the mill stopped while the program was ${program(state)}); nothing goes on by itself`,
  owner_failed: ({ reason }) => t`The computer beside the mill failed: ${reason}`,
};

/** The codes that this table has sentences for. */
export const CODES = Object.keys(SENTENCES);

/** Return {brief, whole, parts}, sentences for {code, values, words}. Without a known code: the words as whole, and no brief.
 * @param {{code?: string, values?: any, words?: string}} code */
export function describe({ code, values, words }) {
  if (!Object.hasOwn(SENTENCES, code ?? "")) return { brief: "", whole: words ? sentence(words) : "" };
  const made = SENTENCES[code];
  const sentences = typeof made === "function" ? made(values ?? {}) : made;
  return typeof sentences === "string" ? { brief: sentences, whole: sentences } : sentences;
}
