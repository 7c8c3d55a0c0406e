/** The programs that this mill has cut, and the hours of each ball; also as a file to save. Fetched when it is unfolded. */

import { api } from "../lib/api.js";
import { h, replace } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { isDry, mark } from "../lib/state.js";
import { ball, hours, percent } from "../lib/words.js";
import { saveBlob } from "../job/save.js";
import { refusalLine } from "./order_controls.js";
import { RUN_STATES } from "./sentences.js";
import { programWords } from "./words.js";

const PAGE = 100;
const SHOWN = 50;
const COLUMNS = {
  run: ({ id }) => id,
  job: ({ job }) => job,
  job_name: ({ job_name: name }) => name,
  program: ({ program }) => program.name,
  ball_radius_mm: (run) => run.setup?.tool?.radius_mm ?? "",
  state: ({ state }) => state,
  operator: ({ operator }) => operator,
  started_at: (run) => run.started_at ?? "",
  ended_at: (run) => run.ended_at ?? "",
  share_cut: (run) => (isDry(run) ? 0 : run.share),
  hours_cut: (run) => (cutSeconds(run) / 3600).toFixed(4),
};

export function history(link) {
  const said = refusalLine();
  const place = h("div", { class: "stack" });
  const fold = h("details", { ontoggle: () => fold.open && said.run(show) }, h("summary", {}, h("h2", { id: "history-title" }, t("History"))), place, said.node);
  const node = h("section", { class: "card folded history", "aria-labelledby": "history-title" }, fold);

  async function show() {
    const runs = (await allRuns(link.name)).filter((run) => run.started_at);
    const save = h("button", { type: "button", onclick: () => saveBlob(new Blob([csvOf(runs)], { type: "text/csv" }), `${link.name}-history.csv`) }, t("Save as CSV"));
    const rows = runs.slice(0, SHOWN).map((run) => h("li", {}, h("span", {}, programWords(run.program.name, run.job_name)), " ", stateOf(run), h("span", { class: "dim" }, factsOf(run))));
    replace(place, h("p", {}, runs.length ? sums(runs) : t("Nothing has been cut on this mill yet.")), runs.length ? [save, h("ol", { class: "given", tabIndex: 0, "aria-label": t("Programs, newest first") }, rows)] : null);
  }

  return { node, update() {} };
}

async function allRuns(machine) {
  const found = [];
  let next = `/v1/runs?machine=${encodeURIComponent(machine)}&limit=${PAGE}`;
  while (next) {
    const page = await api.get(next);
    found.push(...page.runs);
    next = page.next;
  }
  return found;
}

/** Hours of cutting by the program's own time: holds and nights do not wear a ball. */
function cutSeconds(run) {
  return isDry(run) ? 0 : run.share * (run.time_s ?? 0);
}

/** All hours, then those of each ball. */
function sums(runs) {
  const byBall = Map.groupBy(runs, (run) => run.setup?.tool?.radius_mm);
  const total = (some) => hours(some.reduce((sum, run) => sum + cutSeconds(run), 0));
  const each = [...byBall].filter(([radius]) => radius).sort(([a], [b]) => b - a);
  return t`${total(runs)} cut. ${each.map(([radius, some]) => `${ball(radius)}: ${total(some)}`).join(", ")}`;
}

function stateOf({ state }) {
  return mark(...(RUN_STATES[state] ?? ["off", state]));
}

function factsOf(run) {
  const when = new Date(run.started_at).toLocaleString(locale, { dateStyle: "medium", timeStyle: "short", hourCycle: "h23" });
  if (isDry(run)) return [when, t("dry pass"), run.operator].filter(Boolean).join(" · ");
  return [when, hours(cutSeconds(run)), run.share < 1 && percent(run.share), run.operator].filter(Boolean).join(" · ");
}

/** Quote a value that a spreadsheet would misread. */
function csvOf(runs) {
  const cell = (value) => (/^[\w.:+-]*$/.test(value) && !/^[+-]/.test(value) ? value : `"${String(value).replace(/^[=+@-]/, "'$&").replaceAll('"', '""')}"`);
  const lines = runs.map((run) => Object.values(COLUMNS).map((of) => cell(String(of(run)))).join(","));
  return `${[Object.keys(COLUMNS).join(","), ...lines].join("\r\n")}\r\n`;
}
