/**
 * What server and mill say by a code, in sentences: the one table of the page. Values come in here and nowhere else, so that
 * another language is another table. A test holds its keys against the codes of the sources (tests/page/test_words.py).
 */

import { capital, sentence } from "../lib/words.js";

/** State of a mill: [kind, word]. */
export const STATES = {
  disconnected: ["bad", "not connected"],
  connecting: ["busy", "connecting"],
  idle: ["good", "idle"],
  run: ["busy", "running"],
  holding: ["warn", "stopping"],
  held: ["warn", "held"],
  jog: ["busy", "jogging"],
  homing: ["busy", "homing"],
  door: ["warn", "door open"],
  check: ["warn", "check mode, nothing moves"],
  alarm: ["bad", "locked"],
  sleep: ["off", "asleep"],
  tool: ["warn", "waits for a tool change"],
};

/** State of a run: [kind, word]. */
export const RUN_STATES = {
  preparing: ["busy", "being handed to the mill"],
  refused: ["bad", "refused"],
  lost: ["bad", "lost"],
  parked: ["wait", "waits for your start"],
  running: ["busy", "running"],
  holding: ["warn", "stopping"],
  held: ["warn", "held"],
  stopping: ["warn", "being stopped"],
  interrupted: ["bad", "interrupted"],
  recovering: ["busy", "going back to its place"],
  finished: ["good", "finished"],
  aborted: ["off", "stopped"],
};

const mill = (state) => STATES[state]?.[1] ?? state;
const program = (state) => RUN_STATES[state]?.[1] ?? state;

/** Number of an alarm: what has happened, and what to do about it. */
const ALARMS = {
  1: ["hard limit hit", "position lost: free the axis, home again"],
  2: ["move would leave the travel", "position kept: unlock, check zero and program"],
  3: ["reset while moving", "position lost: home or set the zero again"],
  4: ["probe was already touching", "or not connected: check the probe"],
  5: ["probe did not touch within its travel", "move closer and repeat"],
  6: ["homing stopped by a reset", "home again"],
  7: ["homing stopped by the safety door", "close it, home again"],
  8: ["homing could not leave the switch", "check switch, wiring and $27"],
  9: ["homing did not find the switch", "check switch, wiring and travel"],
  10: ["homing of a second motor failed", "or emergency stop: release it, reset, home again"],
  11: ["homing required", "home the mill"],
  12: ["a limit switch is touching", "move off it"],
  13: ["probe protection tripped", "check the probe"],
  14: ["spindle did not reach its speed", "check the spindle"],
  15: ["homing of the second motor failed", "check both switches"],
  16: ["power-on self test failed", "check the controller"],
  17: ["motor fault", "check drives and power"],
};

const alarmWords = (number) => ALARMS[number]?.join(", ") ?? `alarm ${number}, see the manual of its controller`;
const lockedWords = (number) => (number in ALARMS ? `Locked: ${ALARMS[number][0]}.` : "The mill is locked.");

const DOUBTS = {
  restarted: "The controller has restarted since the run stopped, its position is lost",
  unconfirmed: "Nobody had confirmed the position when the run stopped",
  unseen: "Nothing shows that the controller went on without a restart while it was out of sight",
};
const POSITION = "home the mill, or touch off again at the same points of the part (zero of X, Y, Z), or, if you know that it is right, say so.";

const NO_ANSWER = "The computer beside the mill does not answer.";
const unansweredWords = ({ seconds }) => (seconds ? `The computer beside the mill did not answer within ${seconds} s.` : NO_ANSWER);

const fault = (cause) => ({ detail }) => sentence(`${cause}: ${detail}`);

/** code: a sentence, or how it is made of the values; {brief, whole} where a line has no room for all of it, with `parts`: what is folded. */
const SENTENCES = {
  // an order that was refused
  grant_missing: "Not carried out: it came without a word of the mill for it. Press again.",
  grant_unknown: "Not carried out: the mill does not know this order any more. Look at the mill, then press again.",
  grant_expired: "Not carried out: it came to the mill too late. Look at the mill, then press again.",
  grant_stopped: "Not carried out: the mill was told to stop after you pressed. Look at the mill, then press again.",
  grant_lease: "Not carried out: control of the mill has changed since you pressed.",
  control_held: ({ operator }) => `${operator ?? "Somebody else"} has control: ask them, or take over.`,
  control_lost: "You had control and were not heard of for too long: take control again.",
  control_needed: "Nobody has control: take control first.",
  plan_changed: "Not carried out: the way to go on has changed since it was shown. Read it again, then tick again.",
  setup_changed: "Not started: zero or position have changed since you looked. Compare the readout with the block, then tick again.",
  owner_ended: ({ reason }) => `The computer beside the mill has let go of it${reason && ` (${reason})`}: start causticmill mill on it again.`,
  owner_silent: ({ seconds, taken_back: back }) => `The computer beside the mill gave no answer within ${seconds} s, ${back ? "the order was taken back" : "the order may still be carried out"}; use the mill's own stop button.`,
  no_block: ({ text }) => `'${text}' is no line of G-code.`,
  mill_state: ({ state }) => `Not carried out: the mill is ${mill(state)}.`,
  run_state: ({ state }) => `Not carried out. The state of the program: ${program(state)}.`,
  run_live: "Not carried out: another program is on the mill.",
  run_unstarted: "Not carried out: this program was never started. Load it again.",
  travel: ({ detail }) => {
    const brief = "Not started: from this zero the program leaves the travel. Set the zero where it fits, or home the mill if it counts wrongly.";
    const parts = detail.split("\n").map(sentence);
    return { brief, whole: [brief, ...parts].join(" "), parts };
  },
  confirm: ({ effect }) => sentence(effect),
  order_uncertain: ({ order }) => ({
    brief: "Look at the mill: the order may have arrived.",
    whole: `The computer beside the mill does not answer; whether the ${order} arrived is not known: LOOK AT THE MILL, it is not sent again.`,
  }),
  stop_uncertain: unansweredWords,
  order_without_effect: ({ order, state }) => ({
    brief: NO_ANSWER,
    whole: `The computer beside the mill does not answer; the ${order} has not taken effect so far. The state of the program: ${program(state)}.`,
  }),

  // the way to the mill
  agent_absent: NO_ANSWER,
  agent_unreached: NO_ANSWER,
  agent_key_unusable: ({ reason }) => sentence(`The key of the computer beside the mill cannot be used: ${reason}`),
  agent_key_refused: "The computer beside the mill does not take this server's key.",
  agent_other: "Another program answers in place of the computer beside the mill.",
  agent_silent: "The connection to the computer beside the mill has ended.",
  agent_wrong: "The computer beside the mill says what cannot be: is causticmill there of the same version as here?",
  agent_fault: ({ status, reason }) => sentence(`The computer beside the mill answered ${status}: ${reason}`),

  // why a program is as it is
  owner_lost: ({ state }) => `The computer beside the mill stopped while the program was ${program(state)}.`,
  aborted: "Aborted by the operator.",
  taken_back: "Taken back before its start.",
  run_lost: "The computer beside the mill no longer knows this program.",
  run_given_up: "Given up.",
  run_unknown: "No computer beside a mill knows this program.",
  "error reply": fault("Error reply"),
  alarm: ({ alarm, detail }) => sentence(`Alarm: ${alarm ? alarmWords(alarm) : detail}`),
  "controller restarted": fault("Controller restarted"),
  "port lost": fault("Port lost"),
  "replies do not match lines": fault("Replies do not match lines"),
  "garbled reply": fault("Garbled reply"),
  "no reply in time": fault("No reply in time"),
  "position off the programmed path": fault("Position off the programmed path"),
  "echo differs from what was sent": fault("Echo differs from what was sent"),
  "program changed on disk": fault("Program changed on disk"),
  "device reports a fault": fault("Device reports a fault"),

  // why a mill is as it is
  locked: ({ alarm }) => ({ brief: lockedWords(alarm), whole: `${capital(alarmWords(alarm))}.` }),
  locked_until_reset: ({ alarm }) => ({ brief: lockedWords(alarm), whole: `${capital(alarmWords(alarm))}; waits for the controller to take a reset.` }),
  silent: {
    brief: "The mill does not answer.",
    whole: "Nothing answers '?'. After a limit alarm a controller hears nothing but a reset, and while it homes it does not answer either: look at the mill; where it stands, send a reset.",
  },

  // what has to be done first
  connect: ({ state }) => (state === "idle" ? "The mill has not reported its position yet: wait a second." : `The mill is ${mill(state)}: connect it; it does not move by that.`),
  wait: ({ state }) => `The mill is ${mill(state)}: wait until it has carried that out, or hold it.`,
  "stand still": ({ state }) => `The mill is ${mill(state)} and may hold unfinished blocks: reset it, which clears them and, from standstill, keeps the position.`,
  unlock: ({ alarm }) => `The mill is locked${alarm ? ` (${alarmWords(alarm)})` : ""}: home it, which finds its position, or unlock it.`,
  position: ({ doubt }) => `${DOUBTS[doubt]}: ${POSITION}`,
  zero: "The work zero is not where the program was cut, and where that was is not certain. Touch off and set X, Y and Z again.",

  // the log: no sentences
  hold: "HOLD",
  abort: "STOP",
  "jog-cancel": "End of a jog",
  order_taken: ({ order }) => `${order}: taken`,
  order_refused: (told) => `${told.order}: refused. ${tell(told).whole}`,
  settings_read: "Read settings: done",
  run_parked: ({ name }) => `${name}: waits for your start`,
  run_left: ({ name, state }) => `${name}: interrupted (the computer beside the mill stopped while the program was ${program(state)}); nothing goes on by itself`,
  owner_failed: ({ reason }) => `The computer beside the mill failed: ${reason}`,
};

/** The codes that are told in words of this table. */
export const CODES = Object.keys(SENTENCES);

/** {brief, whole, parts} of what is told by {code, values, words}. Where no code is known: the words, and nothing brief. */
export function tell({ code, values, words }) {
  if (!Object.hasOwn(SENTENCES, code ?? "")) return { brief: "", whole: words ? sentence(words) : "" };
  const made = SENTENCES[code];
  const sentences = typeof made === "function" ? made(values ?? {}) : made;
  return typeof sentences === "string" ? { brief: sentences, whole: sentences } : sentences;
}
