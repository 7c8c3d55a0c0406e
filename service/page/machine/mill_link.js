/**
 * The state behind one machine's screen: its state and log as they arrive, the run on the mill, orders one at a time,
 * and stops, which go a separate way and wait for nothing.
 */

import { api } from "../lib/api.js";
import { t } from "../lib/language.js";
import { follow } from "../lib/sse.js";
import { isDry } from "../lib/state.js";
import { sendGranted } from "./granted.js";
import { Lease } from "./lease.js";
import { mills } from "./mills.js";
import { StopSocket } from "./stop_socket.js";
import { Stopper } from "./stopper.js";

const MOST_LOG = 300;
const PASSING = new Set(["idle", "run", "jog", "homing", "holding", "connecting"]); // the head of the page says it
const LOOKED_BACK = 25; // runs, to find the last one that was started
const ANSWER_MS = 1500; // the page waits no longer for the log entry of an order

export class MillLink {
  constructor(name) {
    this.path = `/v1/machines/${encodeURIComponent(name)}`;
    this.name = name;
    this.machine = null;
    this.run = undefined; // not fetched yet; null: there has been none
    this.before = null; // the program that was started before the one that waits now
    this.isTried = false; // whether the one that waits has run here, dry or not
    this.answers = new Map(); // run -> whether X0 Y0 was set for its block, as a person at this page has stated
    this.sameBlock = (run) => this.answers.get(run.id);
    this.looking = false;
    this.log = [];
    this.commands = 0; // number of ended commands, from the log
    this.lastAnswer = null; // of the last of them
    this.pressedStops = 0; // how often a stop was sent from here
    this.away = "";
    this.streamAway = ""; // a server that answers elsewhere may not know this mill yet
    this.gone = "";
    this.listeners = new Set();
    this.sending = false;
    this.unanswered = -1; // number of commands that had ended when an order was taken
    this.lease = Lease.of(this);
    this.socket = new StopSocket();
    this.stopper = new Stopper(name, this.socket);
    const stopListening = api.onAway((away) => this.setAway(away ? t("The server does not answer.") : this.streamAway));
    const stream = follow(`${this.path}/events`, {
      onEvent: (kind, data) => this.receive(kind, data),
      onState: (state, words) => this.setStreamState(state, words),
    });
    this.close = () => {
      stopListening();
      stream.close();
      this.lease.close();
      this.socket.close();
      this.listeners.clear();
    };
  }

  /** Whether this page holds control. */
  get mine() {
    return this.lease.held;
  }

  onChange(fn) {
    this.listeners.add(fn);
  }

  changed() {
    for (const listener of this.listeners) listener(this);
  }

  // ---------------------------------------------------------------- what comes

  receive(kind, data) {
    if (kind === "status") this.takeStatus(data);
    else if (kind === "log") this.takeLogEntry(data);
    this.changed();
  }

  setStreamState(state, words) {
    if (state === "ended") this.gone = words || t("This machine is not known here.");
    if (state === "away") this.stopper.lost = true;
    this.streamAway = state === "away" ? words : "";
    this.setAway(this.streamAway);
  }

  setAway(words) {
    this.away = words;
    this.changed();
  }

  takeStatus(machine) {
    const open = machine.run;
    this.machine = machine;
    this.away = "";
    this.lease.check(machine);
    this.stopper.see(machine);
    mills.hear(machine);
    if (open && open.id === this.run?.id && open.state === this.run.state) {
      Object.assign(this.run, open, { program: this.run.program });
    } else if (open) {
      if (open.id !== this.run?.id) this.run = null; // the view of another run does not apply to this one
      this.lookAtRun(open.id);
    } else if (this.run === undefined || this.run?.open) {
      this.lookAtRun(this.run?.id);
    }
  }

  takeLogEntry(entry) {
    if (entry.code === "settings_read") return; // every request for a plan reads the settings
    if (entry.kind === "state" && PASSING.has(entry.words)) return;
    if (entry.code === "order_taken") return; // its outcome is logged too
    if (this.log.some((one) => one.number === entry.number && one.at_s === entry.at_s)) return;
    this.log.push(entry);
    if (entry.kind === "command") {
      this.commands += 1;
      this.lastAnswer = entry.answer ?? null;
      if (this.run?.state === "parked") this.lookAtRun(this.run.id); // its warnings were for another zero
    }
    if (this.log.length > MOST_LOG) this.log.shift();
  }

  /** The whole run: the one on the mill, or the last one. */
  async lookAtRun(id) {
    if (this.looking) return;
    this.looking = true;
    try {
      const list = async (limit) => (await api.get(`/v1/runs?machine=${encodeURIComponent(this.name)}&limit=${limit}`)).runs;
      const run = id ? await api.get(`/v1/runs/${id}`) : ((await list(1))[0] ?? null);
      const past = run?.state === "parked" ? (await list(LOOKED_BACK)).filter((one) => one.started_at && one.id !== run.id) : [];
      const isSame = ({ job, program }) => job === run.job && program.number === run.program.number;
      [this.run, this.before, this.isTried] = [run, past.find((one) => !isDry(one)) ?? null, past.some(isSame)];
    } catch {
      // asked again with the next status
    } finally {
      this.looking = false;
      this.changed();
    }
  }

  // ---------------------------------------------------------------- messages

  /**
   * Send an order outside a run, once; an Error if it was not accepted. It ends when the log has its result.
   * given: from the moment of the press, if that was earlier.
   */
  order(what, body = {}, given = this.givenNow()) {
    const before = this.commands;
    return this.runExclusively(async () => {
      const answer = await this.give(`${this.path}/control/${what}`, body, given);
      this.unanswered = before; // before anything else may be pressed
      setTimeout(() => this.unanswered === before && this.forgetOrder(), ANSWER_MS);
      return answer;
    });
  }

  /** A person's statement about the block under the waiting program. */
  answerPlace(same) {
    this.answers.set(this.run.id, same);
    this.changed();
  }

  forgetOrder() {
    this.unanswered = -1;
    this.changed();
  }

  /** Whether an order is under way, or accepted and not carried out yet. */
  get busy() {
    return this.sending || this.unanswered === this.commands;
  }

  /** start, resume or recover of the run that is shown. */
  async toRun(action, body) {
    await this.runExclusively(async () => (this.run = await this.give(`/v1/runs/${this.run.id}:${action}`, body)));
    this.changed();
  }

  /** Remove the shown run from the mill. Nothing moves. */
  async abandonRun() {
    await this.runExclusively(async () => (this.run = await api.post(`/v1/runs/${this.run.id}:abort`)));
    this.changed();
  }

  /** Load a program of a job onto the mill, where it waits. Nothing moves. lift_mm: as a dry pass, raised by this. */
  load(job, program, lift_mm) {
    return this.runExclusively(() => api.post(`${this.path}/runs`, { job, program, lift_mm }, { headers: this.lease.headers() }));
  }

  /** Send an order that can start a motion, or change what a motion means. */
  async give(path, body, { stops, headers } = this.givenNow()) {
    const answer = await sendGranted({ machine: this.path, stops, headers }, path, body);
    this.stopper.words = "";
    return answer;
  }

  /** The basis of an order that is pressed now: who has control, and the stops that this page knows. It is refused if a stop came since. */
  givenNow() {
    return { stops: this.stopper.countFrom(this.machine?.mill?.stops), pressed: this.pressedStops, headers: this.lease.headers() };
  }

  /** One at a time, and not while an order is on its way. */
  async runExclusively(act) {
    if (this.busy) throw new Error(t("The order before this one is still on its way."));
    this.sending = true;
    this.changed();
    try {
      return await act();
    } finally {
      this.sending = false;
      this.changed();
    }
  }

  /** hold, abort or jog-cancel: for everybody, at any time, while other orders are on their way. True if it was accepted. */
  async sendUrgent(what) {
    this.pressedStops += 1;
    this.changed();
    try {
      return await this.stopper.stop(what, this.machine, this.away !== "");
    } finally {
      this.changed();
    }
  }
}
