/**
 * Browser notifications for a person who does not watch the page while a mill cuts: it needs a hand, waits for a tool, is done.
 * Permission is asked for at a press, and nothing is shown while this page is visible.
 */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { at } from "../lib/root.js";
import { isDry } from "../lib/state.js";
import { isLive, mills } from "./mills.js";
import { addressOf, needsHand, standingInShop } from "./words.js";

const KEPT = "causticmill-notify";
const before = new Map(); // name of a mill -> {run, hand, word} as it was seen last

/** A switch; nothing if this browser, or a page without TLS from elsewhere, has no notifications. */
export function notifySwitch() {
  if (!globalThis.Notification) return null;
  const button = h("button", { type: "button", onclick: () => set(!mills.inBackground) });
  async function set(on) {
    const granted = on && (await Notification.requestPermission()) === "granted";
    mills.inBackground = granted;
    localStorage.setItem(KEPT, granted ? "on" : "");
    show(on && !granted);
  }
  function show(blocked = false) {
    write(button, blocked ? t("Blocked by the browser") : t("Notify me"));
    button.setAttribute("aria-pressed", String(mills.inBackground));
  }
  show();
  return button;
}

/** Watch from now on, if a person has switched it on. */
export function watchForNotifications() {
  mills.inBackground = globalThis.Notification?.permission === "granted" && localStorage.getItem(KEPT) === "on";
  mills.watch(() => api.away || mills.seen.machines.forEach(compare));
  api.onAway((away) => {
    const cutting = mills.seen.machines.find(isLive);
    if (away && cutting && isWanted()) notify(cutting.name, t("The server does not answer. Look at the mill."));
  });
}

function isWanted() {
  return mills.inBackground && (document.hidden || !document.hasFocus());
}

async function compare(machine) {
  const { name } = machine;
  const was = before.get(name);
  const now = { run: machine.run?.id, hand: needsHand(machine), word: standingInShop(machine).word };
  before.set(name, now);
  if (!was || !isWanted()) return;
  if (now.hand && (!was.hand || now.word !== was.word)) notify(name, now.word);
  else if (was.run && !now.run) notify(name, await endWords(name));
}

/** The outcome of the program that was on the mill. */
async function endWords(name) {
  const { runs } = await api.get(`/v1/runs?machine=${encodeURIComponent(name)}&limit=1`, { quiet: true }).catch(() => ({ runs: [] }));
  const [run] = runs;
  if (run?.state !== "finished") return "";
  if (isDry(run)) return t`The dry pass of ${run.program.name} is over; nothing was cut.`;
  return [t`${run.program.name} is done.`, run.next && t`Next: ${run.next.name}.`].filter(Boolean).join(" ");
}

function notify(name, words) {
  if (!words) return;
  const shown = new Notification(name, { body: words, tag: name, icon: at("/page/icon.svg") });
  shown.onclick = () => {
    focus();
    location.hash = addressOf(name);
  };
}
