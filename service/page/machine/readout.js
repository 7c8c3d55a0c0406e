/** Where the tool is: the numbers one reads from two metres away. */

import { h, write } from "../lib/dom.js";
import { coordinate } from "./words.js";

const AXES = ["X", "Y", "Z"];

export function readout(link) {
  const cells = AXES.map((axis) => ({ axis, work: h("td", { class: "work" }), machine: h("td", { class: "own" }) }));
  const trust = h("p", { class: "trust" });
  const feed = h("dd", {});
  const spindle = h("dd", {});
  const node = h(
    "section",
    { class: "card readout", "aria-label": "Position" },
    h(
      "table",
      {},
      h("thead", {}, h("tr", {}, h("td", {}), h("th", { scope: "col" }, "Work, mm"), h("th", { scope: "col" }, "Machine, mm"))),
      h("tbody", {}, cells.map(({ axis, work, machine }) => h("tr", {}, h("th", { scope: "row" }, axis), work, machine))),
    ),
    h("dl", { class: "pace" }, h("div", {}, h("dt", {}, "Feed"), feed), h("div", {}, h("dt", {}, "Spindle"), spindle)),
    trust,
  );
  return {
    node,
    update() {
      const mill = link.machine?.mill;
      const known = mill && mill.connected && !link.away;
      node.classList.toggle("stale", !known);
      cells.forEach(({ work, machine }, k) => {
        write(work, coordinate(mill?.work_mm?.[k]));
        write(machine, coordinate(mill?.machine_mm?.[k]));
      });
      write(feed, Number.isFinite(mill?.feed_mm_per_min) ? `${Math.round(mill.feed_mm_per_min)} mm/min` : "–");
      write(spindle, spindleWords(mill));
      write(trust, !mill ? "" : !known ? "Last known. Look at the mill." : mill.position_trusted ? "" : "Where the mill stands is not sure.");
    },
  };
}

function spindleWords(mill) {
  if (!mill || mill.spindle_on === null || mill.spindle_on === undefined) {
    return mill?.spindle_rpm ? `${Math.round(mill.spindle_rpm)} rpm` : "–";
  }
  return mill.spindle_on ? `on, ${Math.round(mill.spindle_rpm ?? 0)} rpm` : "off";
}
