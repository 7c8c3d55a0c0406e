/**
 * The mill in the head of every screen: state, share cut, and HOLD. Of several mills it shows the one that moves, as
 * long as it moves, or else the one in the worst state, and mentions the others. On a mill's own screen, which has its
 * own HOLD, it shows another mill that moves or needs a hand.
 */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { mark } from "../lib/state.js";
import { percentUnderWay } from "../lib/words.js";
import { isHeld, isLive, mills } from "./mills.js";
import { addressOf, needsHand, standingInShop, urgency } from "./words.js";

/** Fills the place in the head of the page, which stays empty where no mill is known. */
export function showMill(place) {
  const [name, rest] = [h("span", {}), h("span", {})];
  const state = h("span", { class: "chip-state" });
  const bar = h("progress", { max: 1, "aria-label": t("Cut so far") });
  const link = h("a", {}, h("span", { class: "chip-name" }, name, rest), state, bar);
  const hold = h("button", { type: "button", class: "hold", onclick: () => mills.hold(shown) }, t("HOLD"));
  const alarm = h("p", { class: "arrived", role: "alert" });
  replace(place, hold, link, alarm);
  let shown = "";
  let drawn = "";

  function update() {
    const { machines } = mills.seen;
    const machine = choose(machines, shown);
    place.hidden = !machine;
    document.body.classList.toggle("has-mill", Boolean(machine));
    if (!machine) return;
    shown = machine.name;
    const live = isLive(machine);
    const { share } = machine.run ?? {};
    const { kind, word } = standingInShop(machine);
    const now = [api.away ? "off" : kind, api.away ? t`last seen ${word}` : word, live && share > 0 ? percentUnderWay(share) : ""];
    if (now.join() !== drawn) replace(state, mark(now[0], h("span", {}, now[1])), " ", h("span", {}, now[2]));
    drawn = now.join();
    write(name, machine.name);
    write(rest, restWords(machine, machines));
    link.href = machines.length > 1 && !isOwnScreen(machine) ? "#/machines" : addressOf(machine.name);
    bar.hidden = !(live && share > 0);
    bar.value = share ?? 0;
    hold.style.visibility = live && !isOwnScreen(machine) ? "visible" : "hidden"; // its place is kept
    hold.classList.toggle("taken", isHeld(machine));
    hold.setAttribute("aria-label", t`HOLD ${machine.name}`);
    write(alarm, isOwnScreen(machine) ? "" : mills.stopper(machine.name).words);
  }

  mills.watch(update);
  addEventListener("hashchange", update);
  update();
}

/** The mill to show: the one shown before as long as it moves, so that no press of HOLD means another one. */
function choose(machines, before) {
  const others = machines.filter((one) => !isOwnScreen(one));
  const moving = others.filter(isLive);
  const worst = (moving.length ? moving : others).toSorted((a, b) => urgency(b) - urgency(a))[0];
  const own = machines.find(isOwnScreen);
  if (own && !(moving.length || (worst && needsHand(worst)))) return own;
  return moving.find(({ name }) => name === before) ?? worst;
}

/** Whether others need a person, or else how many there are. */
function restWords({ name }, machines) {
  const others = machines.filter((one) => one.name !== name);
  const hands = others.filter(needsHand).length;
  if (hands) return hands === 1 ? t`+ ${hands} needs a hand` : t`+ ${hands} need a hand`;
  return others.length ? t`+ ${others.length} more` : "";
}

function isOwnScreen(machine) {
  return location.hash.split("?")[0] === addressOf(machine.name);
}
