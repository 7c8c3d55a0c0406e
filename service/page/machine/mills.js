/** All mills that the server knows: polled for the views that show them, each of which can send HOLD to them. */

import { api } from "../lib/api.js";
import { StopSocket } from "./stop_socket.js";
import { Stopper } from "./stopper.js";
import { hasLiveRun, stands } from "./words.js";

const CALM_MS = 3000;
const BUSY_MS = 1000;
const NONE = { machines: [], problems: [] };

const watchers = new Set();
const stoppers = new Map(); // name -> Stopper
let socket = null; // opened with the first mill
let timer = 0;

export const mills = {
  /** The mills as last seen. */
  seen: NONE,
  /** Whether they are polled while the page is hidden. */
  inBackground: false,

  /** Ask the server now. quiet: do not ask a person without access for the code. */
  async look({ quiet = false } = {}) {
    mills.seen = await api.get("/v1/machines", { quiet });
    for (const machine of mills.seen.machines) mills.stopper(machine.name).see(machine);
    notifyListeners();
  },

  /** Take over the state of a mill from its own screen, which gets it sooner than the poll. */
  hear(machine) {
    mills.seen = { ...mills.seen, machines: mills.seen.machines.map((one) => (one.name === machine.name ? machine : one)) };
    notifyListeners();
  },

  /** Call fn() after every poll, news of a mill, or answer to a stop. Returns a function that ends this. */
  watch(fn) {
    watchers.add(fn);
    return () => watchers.delete(fn);
  },

  /** The Stopper of this mill. */
  stopper(name) {
    socket ??= new StopSocket();
    if (!stoppers.has(name)) stoppers.set(name, new Stopper(name, socket));
    return stoppers.get(name);
  },

  /** HOLD; needs no control and does not wait for other orders. */
  async hold(name) {
    const machine = mills.seen.machines.find((one) => one.name === name);
    await mills.stopper(name).stop("hold", machine, api.away);
    notifyListeners();
    again(0);
  },
};

/** Whether HOLD has an effect: something moves or is held, or a program on the mill can continue. */
export function isLive(machine) {
  return ["run", "holding", "held", "jog", "homing"].includes(machine.mill?.state) || hasLiveRun(machine);
}

/** Whether the mill is known to stand still: HOLD is still accepted but has no effect. */
export function isHeld(machine) {
  return !api.away && stands(machine);
}

function notifyListeners() {
  for (const fn of [...watchers]) fn();
}

function again(wait_ms = mills.seen.machines.some(isLive) ? BUSY_MS : CALM_MS) {
  clearTimeout(timer);
  timer = setTimeout(turn, wait_ms);
}

async function turn() {
  const may = api.who.scopes.includes("jobs:read");
  if (may && (mills.inBackground || !document.hidden) && !api.away) await mills.look({ quiet: true }).catch(() => {});
  again();
}

api.onWho(() => again(0));
api.onAway((away) => (notifyListeners(), !away && again(0)));
document.addEventListener("visibilitychange", () => again(0));
