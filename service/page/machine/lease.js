/**
 * Control of one mill: one person at a time. A heartbeat keeps it, also for some minutes after the person has left the
 * view, to read a sheet for example. Meanwhile no order can be given from elsewhere, and the next person can take over.
 * A program needs nobody's control to go on, nor do HOLD and STOP; the page asks before a window with a program closes.
 */

import { api } from "../lib/api.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { addressOf, hasLiveRun, refusal } from "./words.js";

const RENEW_MS = 20_000;
const STALE_MS = 3000;
const AWAY_MINUTES = 10;
const kept = new Map(); // name of a mill -> the lease of its view after the person left it
const HEADER = "Causticmill-Control";

export class Lease {
  /** The lease of this view: the one that was kept when the same person left it, or a new one. */
  static of(link) {
    const found = kept.get(link.name);
    kept.delete(link.name);
    clearTimeout(found?.leaving);
    found?.notice.close();
    if (found?.held && found.holder === api.who.name) return Object.assign(found, { link });
    found?.end();
    return new Lease(link);
  }

  constructor(link) {
    this.link = link;
    this.path = `${link.path}/control`;
    this.secret = "";
    this.operator = "";
    this.since = "";
    this.holder = ""; // whose key took it
    this.leaving = 0;
    this.notice = null; // that it was left
    this.freshUntil = 0;
    this.timer = setInterval(() => this.held && this.renew(), RENEW_MS);
    this.stopListening = api.onAway((away) => !away && this.held && this.renew());
    this.onHide = () => this.held && this.release({ keepalive: true });
    this.onClose = (event) => this.held && hasLiveRun(link.machine) && event.preventDefault();
    addEventListener("pagehide", this.onHide);
    addEventListener("beforeunload", this.onClose);
  }

  get held() {
    return this.secret !== "";
  }

  headers() {
    return this.held ? { [HEADER]: this.secret } : {};
  }

  /** ProblemError 409 if somebody else has it and takeover was not requested. */
  async take({ takeOver = false } = {}) {
    if (!(await api.need("machine:run"))) return;
    this.keep(await api.post(this.path, { operator: api.who.name, take_over: takeOver }));
    this.holder = api.who.name;
    this.link.changed();
  }

  async release(options = {}) {
    const headers = this.headers();
    this.forget();
    this.link.changed();
    await api.delete(this.path, { headers, ...options }).catch(() => {}); // it ends by itself
  }

  /** The person has left the view: show that, and give control back in some minutes unless they return. */
  leave() {
    const { name, machine } = this.link;
    kept.set(name, this);
    this.leaving = setTimeout(() => this.end(), AWAY_MINUTES * 60_000);
    const live = hasLiveRun(machine);
    const more = live ? t` ${machine.run.program} goes on; HOLD and STOP are on its page.` : "";
    const back = { words: t("Back to it"), run: () => (location.hash = addressOf(name)) };
    this.notice = toast(t`You keep control of ${name} for ${AWAY_MINUTES} minutes.${more}`, { action: live ? back : { words: t("Give control back"), run: () => this.end() } });
  }

  /** Give control back, and listen no more: no view has this lease. */
  end() {
    if (kept.get(this.link.name) === this) kept.delete(this.link.name);
    clearTimeout(this.leaving);
    if (this.held) this.release();
    clearInterval(this.timer);
    this.stopListening();
    removeEventListener("pagehide", this.onHide);
    removeEventListener("beforeunload", this.onClose);
  }

  async renew() {
    try {
      this.keep(await api.post(this.path, { operator: this.operator }, { headers: this.headers() }));
    } catch (error) {
      if (error.status === 409) this.lose(refusal(error));
    }
  }

  /** Who has control, according to the mill; a server that has lost the mill does not know, and its last answer is stale. */
  check({ agent, control }) {
    if (!this.held || !agent.reachable || Date.now() < this.freshUntil || control?.since === this.since) return;
    this.lose(control ? t`${control.operator} has taken control.` : t("Control has ended: the server heard nothing from this page for a minute."));
  }

  lose(words) {
    this.forget();
    toast(words, { kind: "bad" });
    this.link.changed();
  }

  close() {
    if (this.held) this.leave();
    else this.end();
  }

  keep({ control, operator, since }) {
    this.secret = control;
    this.operator = operator;
    if (this.since !== since) {
      this.freshUntil = Date.now() + STALE_MS;
      setTimeout(() => this.link.machine && this.check(this.link.machine), STALE_MS + 50); // check the reports that were skipped until then
    }
    this.since = since;
  }

  forget() {
    this.secret = "";
    this.operator = "";
    this.since = "";
  }
}
