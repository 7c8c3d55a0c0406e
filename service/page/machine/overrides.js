/** Overrides: run faster or slower than the program says. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isDry } from "../lib/state.js";
import { enable, refusalLine } from "./order_controls.js";
import { whyNot } from "./words.js";

const STATES = ["idle", "run", "holding", "held", "jog", "door", "check", "alarm", "tool"];
const ROWS = [
  ["feed", t("Feed"), 0, { step: 10, low: 10, high: 200 }],
  ["spindle", t("Spindle"), 2, { step: 10, low: 10, high: 200 }],
  ["rapid", t("Rapids"), 1, { choices: [25, 50, 100] }],
];

export function overrides(link) {
  const words = refusalLine();
  const set = (what, percent) => words.run(() => link.order("override", { what, percent }));
  const rows = ROWS.map(([what, label, place, range]) => row(what, label, range, set, () => link.machine?.mill?.overrides?.[place] ?? 100));
  const spindle = rows[ROWS.findIndex(([what]) => what === "spindle")]; // which stays off in a dry pass
  const node = h("section", { class: "card overrides", "aria-labelledby": "override-title" }, h("h2", { id: "override-title" }, t("Overrides, %")), rows.map((one) => one.node), words.node);
  return {
    node,
    update() {
      const why = whyNot(link, STATES, { besideRun: true });
      for (const one of rows) one.update(why === "" && !link.busy);
      spindle.node.hidden = Boolean(link.run) && isDry(link.run);
    },
  };
}

function row(what, label, range, set, now) {
  const value = h("output", {});
  const buttons = range.choices
    ? range.choices.map((percent) => h("button", { type: "button", "aria-label": t`${label} ${percent} percent`, onclick: () => set(what, percent) }, `${percent}`))
    : [-1, 0, 1].map((sign) => {
        const to = () => (sign ? Math.min(range.high, Math.max(range.low, now() + sign * range.step)) : 100);
        const name = { [-1]: t`${label} slower`, 0: t`${label} 100 percent`, 1: t`${label} faster` }[sign];
        return h("button", { type: "button", "aria-label": name, onclick: () => set(what, to()) }, sign ? `${sign < 0 ? "−" : "+"}${range.step}` : "100");
      });
  const node = h("div", { class: "override" }, h("span", {}, label), value, h("div", { class: "row" }, buttons));
  return {
    node,
    update(able) {
      write(value, `${now()} %`);
      enable(buttons, able);
    },
  };
}
