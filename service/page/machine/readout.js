/** The tool's position in numbers that can be read from two metres away; while a program runs, plots of feed and buffer. */

import { h, svg, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { thousands } from "../lib/words.js";
import { coordinate, hasLiveRun } from "./words.js";

const AXES = ["X", "Y", "Z"];

export function readout(link) {
  const work = AXES.map(() => h("td", { class: "work" }));
  const own = AXES.map(() => h("td", { class: "own" }));
  const head = (words) => h("th", { scope: "row" }, words);
  const trust = h("p", { class: "trust" });
  const pace = { feed: item(t("Feed"), 0), buffer: item(t("Buffer"), 1), spindle: item(t("Spindle")) };
  const node = h(
    "section",
    { class: "card readout", "aria-label": t("Position") },
    h(
      "table",
      {},
      h("thead", {}, h("tr", {}, h("td", {}, "mm"), AXES.map((axis) => h("th", { scope: "col" }, axis)))),
      h("tbody", {}, h("tr", {}, head(t("Work")), work), h("tr", {}, head(t("Machine")), own)),
    ),
    h("div", { class: "beside-place" }, h("dl", { class: "pace" }, Object.values(pace).map((one) => one.node)), trust),
  );
  let seen = null;
  return {
    node,
    update() {
      const mill = link.machine?.mill;
      const known = mill && mill.connected && !link.away;
      const live = hasLiveRun(link.machine);
      node.classList.toggle("stale", !known);
      AXES.forEach((_, k) => {
        write(work[k], coordinate(mill?.work_mm?.[k]));
        write(own[k], coordinate(mill?.machine_mm?.[k]));
      });
      const { feed_mm_per_min: feed, buffer_share: buffer } = mill ?? {};
      pace.buffer.say(Number.isFinite(buffer) ? `${Math.round(100 * buffer)} %` : "–");
      pace.spindle.say(spindleWords(mill));
      pace.buffer.node.hidden = !live || !Number.isFinite(buffer);
      if (link.machine !== seen) for (const [one, value] of [[pace.feed, feed], [pace.buffer, buffer]]) one.plot(live && known ? value : null);
      seen = link.machine;
      const isCutting = live && known && link.machine.run.state === "running" && ["run", "idle"].includes(mill.state);
      const shown = isCutting ? pace.feed.mean() : feed;
      pace.feed.say(Number.isFinite(shown) ? `${thousands(Math.round(shown))} mm/min` : "–");
      write(trust, !mill ? "" : !known ? t("Last known. Look at the mill.") : mill.position_trusted ? "" : t("The position of the mill is not certain."));
    },
  };
}

/** A figure with its name; most: upper limit of its plot, 0: automatic, undefined: no plot. */
function item(name, most) {
  const value = h("dd", {});
  const line = most === undefined ? null : sparkline(name, most);
  return {
    node: h("div", {}, h("dt", {}, name), value, line?.node),
    say: (words) => write(value, words),
    plot: (number) => line.add(number),
    mean: () => line.mean(),
  };
}

function spindleWords(mill) {
  if (!mill || mill.spindle_on === null || mill.spindle_on === undefined) {
    return mill?.spindle_rpm ? t`${thousands(Math.round(mill.spindle_rpm))} rpm` : "–";
  }
  return mill.spindle_on ? t`on, ${thousands(Math.round(mill.spindle_rpm ?? 0))} rpm` : t("off");
}

const SPAN_MS = 60_000;
const MEAN = 8; // reports
const [WIDE, HIGH] = [120, 28];

/**
 * {node, add(value), mean()}; most: the top of the plot, 0: the greatest value so far. null ends the plot and hides it. mean: of
 * the last reports, for between two short lines a mill may stand for a moment, a fast simulated one every second time.
 */
export function sparkline(name, most) {
  const line = svg("polyline", { points: "" });
  const drawn = svg("svg", { viewBox: `0 0 ${WIDE} ${HIGH}`, preserveAspectRatio: "none", role: "img", "aria-label": t`${name} in the last minute` }, line);
  const node = h("dd", { class: "spark", hidden: true }, drawn);
  let points = []; // {at, value}
  return {
    node,
    mean: () => points.slice(-MEAN).reduce((sum, one) => sum + one.value, 0) / Math.min(MEAN, points.length),
    add(value) {
      const at = performance.now();
      points = Number.isFinite(value) ? [...points.filter((one) => at - one.at < SPAN_MS), { at, value }] : [];
      node.hidden = points.length < 2;
      const top = most || Math.max(1, ...points.map((one) => one.value));
      const place = (one) => `${(WIDE * (1 - (at - one.at) / SPAN_MS)).toFixed(1)},${((HIGH - 2) * (1 - Math.min(1, one.value / top)) + 1).toFixed(1)}`;
      line.setAttribute("points", points.map(place).join(" "));
    },
  };
}
