/**
 * Control of one mill: one person at a time. A heartbeat keeps it, and leaving the view gives it back with a notice: a
 * person who looks elsewhere does not see what moves, and the next person need not wait. A program goes on without
 * anybody's control, and HOLD and STOP need none; the page asks before a window with a program closes.
 */

import { api } from "../lib/api.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { addressOf, hasLiveRun, refusal } from "./words.js";

const RENEW_MS = 20_000;
const STALE_MS = 3000;
const HEADER = "Causticmill-Control";

export class Lease {
  constructor(link) {
    this.link = link;
    this.path = `${link.path}/control`;
    this.secret = "";
    this.operator = "";
    this.since = "";
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

  /** ProblemError 409 if somebody else has it and it was not to be taken over. */
  async take({ takeOver = false } = {}) {
    if (!(await api.need("machine:run"))) return;
    this.keep(await api.post(this.path, { operator: api.who.name, take_over: takeOver }));
    this.link.changed();
  }

  async release(options = {}) {
    const headers = this.headers();
    this.forget();
    this.link.changed();
    await api.delete(this.path, { headers, ...options }).catch(() => {}); // it ends by itself
  }

  leave() {
    const { name, machine } = this.link;
    const live = hasLiveRun(machine);
    const more = live ? t` ${machine.run.program} goes on; HOLD and STOP are on its page.` : "";
    const back = { words: t("Back to it"), run: () => (location.hash = addressOf(name)) };
    toast(t`You gave back control of ${name}.${more}`, { kind: live ? "bad" : "", action: live ? back : undefined });
    this.release();
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
    clearInterval(this.timer);
    this.stopListening();
    removeEventListener("pagehide", this.onHide);
    removeEventListener("beforeunload", this.onClose);
    if (this.held) this.leave();
  }

  keep({ control, operator, since }) {
    this.secret = control;
    this.operator = operator;
    if (this.since !== since) {
      this.freshUntil = Date.now() + STALE_MS;
      setTimeout(() => this.link.machine && this.check(this.link.machine), STALE_MS + 50); // what was passed over until then
    }
    this.since = since;
  }

  forget() {
    this.secret = "";
    this.operator = "";
    this.since = "";
  }
}
