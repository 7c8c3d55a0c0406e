/** The spindle by hand, outside programs. The mill switches it off when control ends, and with HOLD and STOP. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { thousands } from "../lib/words.js";
import { guardedButton } from "./ask.js";
import { field, number } from "./probe.js";
import { enable } from "./refusal_line.js";

export function spindlePart(order) {
  const rpm = number("", { min: 1, max: 1e6, step: 1 });
  rpm.required = true;
  rpm.oninput = () => (rpm.dataset.said = "yes");
  const on = guardedButton(t("Spindle on"), {
    words: () => t`The spindle starts at once, at ${thousands(rpm.valueAsNumber)} rpm. Is the tool tight, the wrench off, and is nobody near it?`,
    yes: t("Start the spindle"),
    act: () => order("spindle", { on: true, rpm: rpm.valueAsNumber }),
  });
  const off = h("button", { type: "button", onclick: () => order("spindle", { on: false }) }, t("Spindle off"));
  const about = h("p", { class: "dim" });
  const form = h("div", { class: "probe-form" }, field(t("Speed"), rpm, "rpm"), on.node, off);
  const node = h("details", { class: "probe" }, h("summary", {}, t("Spindle by hand")), form, about);
  return {
    node,
    close: on.close,
    /** able: whether the mill takes orders now. */
    update({ machine, run }, able) {
      const [slowest, fastest] = machine?.profile?.spindle_rpm ?? [1, 1e6];
      Object.assign(rpm, { min: Math.max(1, slowest), max: fastest });
      const wanted = run?.setup?.tool?.spindle_rpm ?? Math.max(1, slowest);
      if (!rpm.dataset.said && rpm.value !== String(wanted)) rpm.value = wanted;
      write(about, t`This mill turns at ${thousands(slowest)} to ${thousands(fastest)} rpm. The spindle goes off with HOLD and STOP, and when you give back or lose control. While it is on, no program starts and nothing is probed.`);
      enable([on.button], able && rpm.checkValidity());
      enable([off], able);
      if (machine?.mill?.spindle_on && able) node.open = true;
    },
  };
}
