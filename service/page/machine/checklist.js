/** The checks of a person before the mill moves: every tick is required again each time, with a name. */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isDry } from "../lib/state.js";
import { ball, thousands } from "../lib/words.js";
import { enable } from "./order_controls.js";

/**
 * Ticks for `run.required_checks`, the operator's name, and the button that is on when nothing is missing; under it the
 * mill's answer (`words`), so that nothing above the button ever moves. act({operator, checks}) gives the order.
 */
export function checklist(run, { label, words, act, changed = () => {} }) {
  const boxes = run.required_checks.map((check) => ({ check, box: h("input", { type: "checkbox", onchange: () => ((lost = ""), count(), changed()) }) }));
  const operator = h("input", { type: "text", maxLength: 100, autocomplete: "name", value: api.who.paired ? api.who.name : "", oninput: () => (count(), changed()) });
  const go = h("button", { type: "button", class: "big go", onclick: () => act({ operator: operator.value.trim(), checks: boxes.map(({ check }) => check) }) }, label);
  const missing = h("p", { class: "missing", role: "status" });
  let [why, lost] = ["", ""];
  const count = () => {
    const left = boxes.filter(({ box }) => !box.checked).length;
    const named = operator.value.trim() !== "";
    const lacking = left ? t`${left} of ${boxes.length} still to tick.` : named ? "" : t("Give your name.");
    enable([go], why === "" && lacking === "");
    write(missing, why || lost || lacking);
  };
  count();
  const node = h(
    "div",
    { class: "checklist" },
    h("fieldset", {}, h("legend", {}, t("Look, then tick")), boxes.map(({ check, box }) => line(check, box, run))),
    h("label", { class: "field" }, h("span", {}, t("Operator")), operator),
    go,
    missing,
    words.node,
  );
  return {
    node,
    button: go,
    get named() {
      return operator.value.trim() !== "";
    },
    get ticked() {
      return boxes.every(({ box }) => box.checked);
    },
    /** reason: why the order cannot be given now; "" if it can. isNext: whether it is the next step. settled: may be ticked. */
    update(reason, isNext, settled = true) {
      why = reason;
      enable(boxes.map(({ box }) => box), settled);
      go.classList.toggle("primary", isNext);
      count();
    },
    /** Clear ticks whose facts may have changed; words give the reason if a tick is lost. */
    clear(words = "") {
      if (boxes.some(({ box }) => box.checked)) lost = words;
      for (const { box } of boxes) box.checked = false;
      count();
    },
  };
}

function line(check, box, run) {
  const [words, more] = checkWords(check, run);
  return h("label", { class: "tick" }, box, h("span", {}, words, more && h("small", {}, more)));
}

/** Every program switches the spindle on, which has no effect on a spindle with its own switch. */
function spindleWords(run, rpm) {
  if (isDry(run)) return t("a dry pass: the spindle stays off");
  return rpm ? t`the program switches the spindle on, at ${thousands(rpm)} rpm; if yours has a switch of its own, turn it on now` : "";
}

/** The checks of a person before the mill moves; `setup` of the run gives the right values. */
function checkWords(check, run) {
  const { tool, stock, zero, change } = run.setup ?? {};
  switch (check) {
    case "tool":
      return [t("The tool is in and tight"), [tool && `${tool.shape}, ${ball(tool.radius_mm)}`, change?.words].filter(Boolean).join("; ")];
    case "zero":
      return [t("The work zero is set for this tool"), zero ?? ""];
    case "stock":
      return [t("The block is clamped"), stock ? `${stock.width_mm} × ${stock.height_mm} × ${stock.thickness_mm} mm, ${stock.material.toUpperCase()}` : ""];
    case "clear":
      return [t("Nothing is in the way of the tool"), [t("hands, clamps, wrenches, the probe's cable; goggles on"), spindleWords(run, tool?.spindle_rpm)].filter(Boolean).join("; ")];
    case "position":
      return [t("The position shown is where the tool really is"), t("compare the readout with the block")];
    case "order":
      return [t("Passes may be left out"), t`not finished on this mill: ${run.left_out.map((one) => one.name).join(", ")}`];
    default:
      return [check, ""];
  }
}
