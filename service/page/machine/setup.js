/** Before a program: home, the work zero by hand or by probe, the way to it, the spindle by hand, unlock and reset. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isZeroKnown } from "./place.js";
import { cornerPart, field, number, probePart } from "./probe.js";
import { enable, guardedButton, refusalLine } from "./order_controls.js";
import { whyNot } from "./words.js";
import { thousands } from "../lib/words.js";

const STANDS = ["idle", "alarm", "held", "check", "sleep", "door"];

export function setup(link) {
  const words = refusalLine();
  const order = (what, body) => words.run(() => link.order(what, body));
  const home = h("button", { type: "button", onclick: () => order("home") }, t("Home"));
  const unlock = guardedButton(t("Unlock"), {
    words: t("Unlocking does not tell the mill where it is. Is the tool free, and is the position shown right? If not, home the mill instead."),
    yes: t("Unlock it"),
    act: () => order("unlock"),
  });
  const reset = guardedButton(t("Reset"), {
    words: t("A reset clears everything that the mill still holds. From standstill it keeps its position."),
    yes: t("Reset it"),
    act: () => order("reset"),
  });
  const zeros = ["X", "Y", "XY", "Z"].map((axes) => h("button", { type: "button", onclick: () => order("zero", { axes }) }, axes === "XY" ? t("X and Y = 0 here") : t`${axes} = 0 here`));
  const probe = probePart(order);
  const corner = cornerPart(order, () => link.changed());
  const spindle = spindlePart(order);
  const ways = [
    guardedButton(t("Go to X0 Y0"), {
      words: t("The tool goes up to the safe height, then straight to X0 Y0. Is the way free?"),
      yes: t("Go there"),
      act: () => order("go-to-zero", { axes: "XY" }),
    }),
    guardedButton(t("Go to X0 Y0 Z0"), {
      words: t("The tool goes up to the safe height, across to X0 Y0, and slowly down to Z0, where it touches the block. Is the way free?"),
      yes: t("Go down there"),
      act: () => order("go-to-zero", { axes: "XYZ" }),
    }),
  ];
  const hint = h("p", { class: "dim" });
  const node = h(
    "section",
    { class: "card setup", "aria-labelledby": "setup-title" },
    h("h2", { id: "setup-title" }, t("Zero and home")),
    h("div", { class: "row" }, home, unlock.node, reset.node),
    hint,
    h("h3", {}, t("Work zero")),
    h("div", { class: "row zeros" }, zeros),
    h("div", { class: "row" }, ways.map((one) => one.node)),
    probe.node,
    corner.node,
    spindle.node,
    words.node,
  );
  return {
    node,
    update() {
      const idle = whyNot(link);
      const locked = whyNot(link, ["idle", "alarm"]);
      const homing = link.machine?.profile?.homing;
      write(hint, homing === false ? t("This mill has no homing switches: jog to the corner of the block and set the zero there.") : "");
      enable([home], locked === "" && homing !== false && !link.busy);
      const notLocked = whyNot(link, ["alarm"]);
      enable([unlock.button], notLocked === "" && !link.busy);
      unlock.button.title = notLocked;
      enable([reset.button], whyNot(link, STANDS) === "" && !link.busy);
      enable([...zeros, probe.button], idle === "" && !link.busy);
      corner.update(link.run?.setup);
      enable([corner.button], idle === "" && !link.busy && corner.isWhole);
      enable(ways.map((one) => one.button), idle === "" && !link.busy && isZeroKnown(link.machine, "XYZ"));
      spindle.update(link, idle === "" && !link.busy);
      if (idle) for (const part of [probe, corner, spindle, ...ways]) part.close();
      if (notLocked) unlock.close();
    },
  };
}

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
      write(about, t`This mill turns at ${thousands(slowest)} to ${thousands(fastest)} rpm. Switched on here, the spindle goes off with HOLD and STOP, and when you give back or lose control. While it is on, no program starts and nothing is probed.`);
      enable([on.button], able && rpm.checkValidity());
      enable([off], able);
      if (machine?.mill?.spindle_on && able) node.open = true;
    },
  };
}
