/**
 * Steps of the jog that add up: a press while the step before is under way waits here, and all that wait in one direction
 * go as one order when that step has ended. A waiting step carries the control and the stop count at its press, so the
 * mill itself refuses it after a stop that this page does not know about.
 *
 * All waiting steps are dropped at once, and the page says so, when anything but the end of a step comes between: a stop, a refusal, a
 * step that ended elsewhere, a lost mill, the end of control, a page out of sight, or time.
 */

import { t } from "../lib/language.js";
import { stopwatch } from "./granted.js";
import { isPlaced } from "./place.js";
import { whyNot } from "./words.js";

export const MOST_WAITING_MM = 20;
const MOST_WAIT_MS = 5000;
const LOGGED_MS = 2000;
const REACHED_MM = 0.02; // a step of a coarse mill
const TINY_MM = 1e-9;
const AXES = "XYZ";

/** send(by_mm, feed, given): order a jog with the time of its press; true if it was taken. changed: called when the waiting steps change. */
export class WaitingSteps {
  constructor(link, { send, changed }) {
    this.link = link;
    this.send = send;
    this.changed = changed;
    this.waiting = []; // {by_mm, feed, given, age_ms()}, the next first
    this.underWay = null; // {by_mm, before, taken}: sent from here and not ended yet; before: how many commands had ended
    this.dropped = ""; // what was, in words
  }

  /** A step that was pressed now goes at once, or waits; an Error if it may not wait. */
  async press(by_mm, feed) {
    this.dropped = "";
    this.update(); // the step before may just have ended, and the waiting ones may have to be dropped
    const step = { by_mm, feed, given: this.link.givenNow(), age_ms: stopwatch() };
    if (!this.underWay) return this.go(step);
    if (this.length + Math.hypot(...by_mm) > MOST_WAITING_MM + TINY_MM) {
      throw new Error(t`Not more than ${MOST_WAITING_MM} mm can wait: press again when the mill stands.`);
    }
    const last = this.waiting.at(-1);
    if (last && last.feed === feed && isAlong(last.by_mm, by_mm) && isSame(last.given, step.given)) last.by_mm = last.by_mm.map((mm, k) => mm + by_mm[k]);
    else this.waiting.push(step);
    this.changed();
  }

  /** Total distance of the waiting steps, mm. */
  get length() {
    return this.waiting.reduce((sum, { by_mm }) => sum + Math.hypot(...by_mm), 0);
  }

  /** The waiting steps in words; "" if there are none. */
  get words() {
    return this.waiting.map(({ by_mm }) => wayWords(by_mm)).join(", ");
  }

  /** Send the next one if the mill is free for it; drop all if it must not be sent any more. */
  update() {
    const { link } = this;
    if (this.underWay) this.underWay = this.follow(this.underWay);
    const [next] = this.waiting;
    if (!next) return;
    const mayFollow = !document.hidden && next.age_ms() < MOST_WAIT_MS && isSame(next.given, link.givenNow()) && whyNot(link, ["idle", "jog"]) === "";
    if (!mayFollow) this.drop();
    else if (!this.underWay) this.go(this.waiting.shift());
  }

  async go({ by_mm, feed, given }) {
    const step = { by_mm, before: this.link.commands, taken: false, still_ms: null };
    this.underWay = step;
    this.changed();
    step.taken = await this.send(by_mm, feed, given);
    if (step.taken) return;
    this.underWay = null;
    this.drop();
  }

  /** The step while it is under way, null after it. If it ended at another place, or at an unknown one, nothing follows it. */
  follow(step) {
    const { link } = this;
    if (!step.taken || link.busy || whyNot(link) !== "") {
      step.still_ms = null;
      return step;
    }
    const isKnown = link.commands === step.before + 1;
    step.still_ms ??= stopwatch();
    if (link.commands === step.before && step.still_ms() < LOGGED_MS) return step; // the log may come after the state
    const { moved_mm: moved, at_machine_mm: at } = isKnown ? (link.lastAnswer ?? {}) : {};
    if (!isNear(moved, step.by_mm)) this.drop();
    else if (isPlaced(link.machine.mill) && !isNear(at, link.machine.mill.machine_mm)) return step; // the status is older
    return null;
  }

  drop() {
    if (!this.waiting.length) return;
    this.dropped = t`Not carried out: ${this.words}.`;
    this.waiting = [];
    this.changed();
  }
}

/** Whether both go the same way, so that their sum takes no other path. */
function isAlong(one, other) {
  return one.map(Math.sign).join() === other.map(Math.sign).join();
}

function isNear(one, other) {
  return Boolean(one?.every((mm, k) => Math.abs(mm - other[k]) <= REACHED_MM));
}

function isSame(one, other) {
  return one.stops === other.stops && one.pressed === other.pressed && JSON.stringify(one.headers) === JSON.stringify(other.headers);
}

function wayWords(by_mm) {
  const moved = by_mm.map((mm, k) => mm && `${AXES[k]} ${mm > 0 ? "+" : "−"}${Number(Math.abs(mm).toFixed(3))} mm`);
  return moved.filter(Boolean).join(", ");
}
