/** Stops of one mill: sends them both ways, and reports one that did not arrive. */

import { api } from "../lib/api.js";
import { t } from "../lib/language.js";
import { refusal, stands } from "./words.js";

const OTHER_WAY_MS = 300; // a stop without an answer by then is also sent as a request
const STOP_ANSWER_MS = 6000;
const BEHIND_MS = 1000;
const LOST_MS = 1000; // until then, a request that died with its server is sent once more: another server takes it
const BUTTON = t("Use the stop button on the mill itself.");

export class Stopper {
  /** socket: a StopSocket, which other mills may share. */
  constructor(name, socket) {
    this.name = name;
    this.socket = socket;
    this.words = ""; // shown for a stop that did not arrive
    this.lost = false; // whether the mill has been out of reach since then
    this.run = ""; // the run that was on the mill then
    this.answered = { count: 0, until: 0 }; // the count after the last stop; until when other messages may lag behind it
    this.aborts = 0; // how often STOP was pressed
  }

  /** hold, abort or jog-cancel. Return true if the mill took it. machine: its last known state; away: no messages come from it. */
  async stop(what, machine, away) {
    try {
      await this.send(what);
      this.words = "";
      return true;
    } catch ({ errors }) {
      this.words = t`${what === "hold" ? t("HOLD") : t("STOP")} did not arrive. ${BUTTON} (${refusal(errors.at(-1))})`;
      this.run = machine?.run?.id ?? "";
      this.lost = away; // reported once for a mill that is out of reach
      return false;
    }
  }

  /** Show that a stop did not arrive until the mill is seen to stand, is within reach again, or runs another program. */
  see(machine) {
    const { agent, mill, run } = machine;
    if (!this.words) return;
    if (!agent.reachable || !mill?.connected) this.lost = true;
    else if (this.lost || stands(machine) || (run?.id ?? "") !== this.run) this.words = "";
  }

  /** The count of stops of the mill; heard: the count it last reported. */
  countFrom(heard) {
    return Date.now() < this.answered.until ? Math.max(heard ?? 0, this.answered.count) : heard;
  }

  /**
   * Send a stop by both ways, by the second only if the first does not answer at once: a stop that arrives twice does
   * no harm. After a later STOP nothing is sent again: a HOLD behind it would hold a mill that has been cleared.
   */
  send(what) {
    if (what === "abort") this.aborts += 1;
    const { aborts } = this, pressed = Date.now();
    const timeout = new Error("No answer in time.");
    const note = ({ mill }) => (this.answered = { count: mill?.stops ?? 0, until: Date.now() + BEHIND_MS });
    const first = Promise.race([this.socket.send(this.name, what), after(STOP_ANSWER_MS).then(() => Promise.reject(timeout))]).then(note);
    const how = { timeout_ms: STOP_ANSWER_MS, quiet: true, keepalive: true };
    const ask = () => api.post(`/v1/machines/${encodeURIComponent(this.name)}/control/${what}`, {}, how).then(note);
    const isLost = ({ status }) => status === 0 && Date.now() - pressed < LOST_MS && aborts === this.aborts;
    const post = () => ask().catch((error) => (isLost(error) ? ask() : Promise.reject(error)));
    if (document.hidden || globalThis.event?.type === "pagehide") return Promise.any([first, post()]); // no time is left
    let answered = false;
    first.then(() => (answered = true)).catch(() => {});
    const second = Promise.race([after(OTHER_WAY_MS), first.catch(() => {})])
      .then(/** @returns {any} */ () => answered || aborts !== this.aborts || post());
    return Promise.any([first, second]);
  }
}

function after(ms) {
  return new Promise((done) => setTimeout(done, ms));
}
