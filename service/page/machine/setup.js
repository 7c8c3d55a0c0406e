/** Before a program: home, the work zero by hand or by probe, the way to it, the spindle by hand, unlock and reset. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { guardedButton } from "./ask.js";
import { isZeroKnown } from "./place.js";
import { cornerPart, probePart } from "./probe.js";
import { enable, refusalLine } from "./refusal_line.js";
import { spindlePart } from "./spindle.js";
import { whyNot } from "./words.js";

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
