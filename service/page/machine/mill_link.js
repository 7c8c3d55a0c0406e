/**
 * All that one machine's screen knows and says: state and log as they come, the run that is on the mill, orders.
 *
 * A browser keeps few connections to one server. A stream takes one, so it is closed while nobody looks at the page,
 * and orders leave one after the other; a hold or a stop that gets no answer at once takes the place of all of them.
 */

import { api } from "../lib/api.js";
import { follow } from "../lib/sse.js";
import { Lease } from "./lease.js";
import { refusal } from "./words.js";

const MOST_LOG = 300;
const PASSING = new Set(["idle", "run", "jog", "homing", "holding", "connecting"]); // the head of the page says it
const ROOM_AFTER_MS = 400;
const ANSWER_MS = 1500; // an order of which the log says nothing by then is no reason to wait
const URGENT_MS = 6000;
const BUTTON = "Use the stop button on the mill itself.";

export class MillLink {
  constructor(name) {
    this.path = `/v1/machines/${encodeURIComponent(name)}`;
    this.name = name;
    this.machine = null;
    this.run = undefined; // not looked for yet; null: there has been none
    this.looking = false;
    this.log = [];
    this.commands = 0; // that have ended, as the log tells
    this.closed = false;
    this.away = "";
    this.gone = "";
    this.urgentWords = "";
    this.listeners = new Set();
    this.orders = new AbortController();
    this.sending = false;
    this.unanswered = -1; // number of commands that had ended when an order was taken
    this.lease = new Lease(this);
    this.stopListening = [api.onAway((away) => this.setAway(away ? "The server does not answer." : ""))];
    const look = () => (document.hidden ? this.pause() : this.listen());
    document.addEventListener("visibilitychange", look);
    this.stopListening.push(() => document.removeEventListener("visibilitychange", look));
    look();
  }

  /** Whether this page holds control. */
  get mine() {
    return this.lease.held;
  }

  onChange(fn) {
    this.listeners.add(fn);
  }

  changed() {
    for (const tell of this.listeners) tell(this);
  }

  close() {
    this.closed = true;
    this.pause();
    this.lease.close();
    for (const stop of this.stopListening) stop();
    this.listeners.clear();
  }

  // ---------------------------------------------------------------- what comes

  listen() {
    if (this.closed) return;
    this.stream ??= follow(`${this.path}/events`, {
      onEvent: (kind, data) => this.heard(kind, data),
      onState: (state, words) => this.streamed(state, words),
    });
  }

  pause() {
    this.stream?.close();
    this.stream = null;
  }

  heard(kind, data) {
    if (kind === "status") this.told(data);
    else if (kind === "log") this.noted(data);
    this.changed();
  }

  streamed(state, words) {
    if (state === "ended") this.gone = words || "This machine is not known here.";
    this.setAway(state === "away" ? words : "");
  }

  setAway(words) {
    this.away = words;
    this.changed();
  }

  told(machine) {
    const open = machine.run;
    this.machine = machine;
    this.away = "";
    this.lease.seen(machine.control);
    if (open && open.id === this.run?.id && open.state === this.run.state) {
      Object.assign(this.run, open, { program: this.run.program });
    } else if (open) {
      if (open.id !== this.run?.id) this.run = null; // another one's words are not this one's
      this.lookAtRun(open.id);
    } else if (this.run === undefined || this.run?.open) {
      this.lookAtRun(this.run?.id);
    }
  }

  noted(entry) {
    if (entry.words.startsWith("Read settings: done")) return; // every look at a plan asks for them
    if (entry.kind === "state" && PASSING.has(entry.words)) return;
    if (this.log.some((one) => one.number === entry.number && one.at_s === entry.at_s)) return;
    this.log.push(entry);
    if (entry.kind === "command") this.commands += 1;
    if (this.log.length > MOST_LOG) this.log.shift();
  }

  /** The whole run: the one that is on the mill, or else the one that was there last. */
  async lookAtRun(id) {
    if (this.looking) return;
    this.looking = true;
    try {
      const last = async () => (await api.get(`/v1/runs?machine=${encodeURIComponent(this.name)}&limit=1`)).runs[0] ?? null;
      this.run = id ? await api.get(`/v1/runs/${id}`) : await last();
    } catch {
      // asked again with the next status
    } finally {
      this.looking = false;
      this.changed();
    }
  }

  // ---------------------------------------------------------------- what is said

  /** An order beside a run. Sent once; ProblemError where it was not taken. Over when the log says what came of it. */
  async order(what, body = {}) {
    const before = this.commands;
    const told = await this.send(`${this.path}/control/${what}`, body);
    this.unanswered = before;
    setTimeout(() => this.unanswered === before && this.forgetOrder(), ANSWER_MS);
    return told;
  }

  forgetOrder() {
    this.unanswered = -1;
    this.changed();
  }

  /** An order is on its way, or taken and not carried out yet. */
  get busy() {
    return this.sending || this.unanswered === this.commands;
  }

  /** start, resume or recover of the run that is shown. */
  async toRun(action, body) {
    const run = await this.send(`/v1/runs/${this.run.id}:${action}`, body);
    this.run = run;
    this.changed();
  }

  /** Anything that needs control: one at a time, and not while one is on its way. */
  async send(path, body) {
    if (this.busy) throw new Error("The order before this one is still on its way.");
    this.sending = true;
    this.changed();
    try {
      const headers = this.lease.headers();
      return await api.post(path, body, { headers, signal: this.orders.signal });
    } finally {
      this.sending = false;
      this.changed();
    }
  }

  /** hold, abort or jog-cancel: from everybody, at any time, whatever else is on its way. True where it was taken. */
  async urgent(what) {
    const room = setTimeout(() => this.makeRoom(), ROOM_AFTER_MS);
    try {
      await api.post(`${this.path}/control/${what}`, {}, { patience_ms: URGENT_MS });
      this.urgentWords = "";
      return true;
    } catch (error) {
      this.urgentWords = `${what === "hold" ? "HOLD" : "STOP"} did not arrive. ${BUTTON} (${refusal(error)})`;
      return false;
    } finally {
      clearTimeout(room);
      this.listen();
      this.changed();
    }
  }

  /** Gives up whatever else this screen has under way, so that the browser has a connection for what is urgent. */
  makeRoom() {
    this.orders.abort();
    this.orders = new AbortController();
    this.pause();
  }
}
