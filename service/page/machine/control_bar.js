/** Shows who has control, and lets a person take it. */

import { toast } from "../lib/dialog.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { ago } from "../lib/words.js";
import { guardedButton } from "./order_controls.js";
import { refusal } from "./words.js";

export function controlBar(link) {
  const take = (takeOver) => link.lease.take({ takeOver }).catch((error) => toast(refusal(error), { kind: "bad" }));
  const free = h("button", { type: "button", onclick: () => take(false) }, t("Take control"));
  const give = h("button", { type: "button", onclick: () => link.lease.release() }, t("Give control back"));
  const over = guardedButton(t("Take over"), {
    words: () => t`${link.machine.control?.operator ?? t("Nobody")} loses control of this mill at once. Have you asked them?`,
    yes: t("Take over"),
    act: () => take(true),
  });
  const who = h("p", { class: "who", role: "status" });
  const place = h("div", { class: "row" });
  const node = h("section", { class: "control", "aria-label": t("Control") }, who, place);
  let shown = "";
  return {
    node,
    update(nextStep) {
      free.classList.toggle("primary", nextStep.step === "control");
      const control = link.machine?.control;
      const now = link.mine ? "mine" : control ? "other" : "free";
      const words = { mine: t("You have control."), other: t`${control?.operator} has control (${ago(control?.since)}).`, free: t("Nobody has control.") }[now];
      const unknown = Boolean(link.away) || link.machine?.agent.reachable === false;
      write(who, unknown ? t("Control is unknown.") : words);
      for (const button of [free, give, over.button]) button.disabled = unknown;
      if (now === shown) return;
      shown = now;
      over.close();
      replace(place, { mine: give, other: over.node, free }[now]);
    },
  };
}
