/** The program that is on the mill: waiting for its start, under way, or over. */

import { h, replace, write } from "../lib/dom.js";
import { mark, shape } from "../lib/state.js";
import { hours, percent } from "../lib/words.js";
import { checklist } from "./checklist.js";
import { guarded } from "./ask.js";
import { said } from "./said.js";
import { RUN_WORDS, runStanding, sentence, whyNot } from "./words.js";

export function running(link, { onNext }) {
  const words = said();
  const state = h("div", {});
  const title = h("h2", { id: "run-title" });
  const more = h("div", { class: "stack" });
  const progress = meter();
  const node = h("section", { class: "card running", "aria-labelledby": "run-title" }, h("div", { class: "row spread" }, title, state), progress.node, more, words.node);
  let shown = "";
  let list = null;
  let idle = true;

  const fill = (run) => {
    list = run.state === "parked" ? checklist(run, { label: `Start ${run.program.name}`, act: (said) => words.during(() => link.toRun("start", said)) }) : null;
    replace(more, notes(run), run.state === "parked" && waiting(link, run, list, words), run.state === "finished" && finished(link, run, onNext));
  };
  return {
    node,
    update() {
      const { run } = link;
      node.hidden = !run;
      if (!run) return;
      const now = `${run.id} ${run.state} ${run.warnings?.length} ${run.words}`;
      if (now !== shown) fill(run);
      shown = now;
      const [kind, word] = runStanding(run, link.machine);
      if (state.textContent !== word) replace(state, mark(kind, word));
      write(title, `${run.program.name}${run.setup?.tool ? `, ball R ${run.setup.tool.radius_mm} mm` : ""}`);
      progress.update(run);
      const stands = link.machine?.mill?.state === "idle";
      if (idle && !stands) list?.clear();
      idle = stands;
      list?.update(whyNot(link));
    },
  };
}

function meter() {
  const share = h("strong", {});
  const bar = h("progress", { max: 1, "aria-label": "Cut so far" });
  const line = h("span", {});
  const left = h("span", {});
  const node = h("div", { class: "meter" }, h("div", { class: "row spread" }, share, left), bar, line);
  return {
    node,
    update(run) {
      node.hidden = run.state === "preparing" || run.state === "refused";
      write(share, percent(run.share));
      bar.value = run.share;
      write(line, run.lines ? `line ${run.executed_line.toLocaleString()} of ${run.lines.toLocaleString()}` : "");
      const over = !Number.isFinite(run.time_left_s) || run.state === "finished" || run.state === "aborted";
      write(left, over ? "" : `${hours(run.time_left_s)} left`);
    },
  };
}

function notes(run) {
  const own = run.words && !["interrupted", "aborted"].includes(run.state) ? [run.words] : []; // said above, with what to do
  const kind = RUN_WORDS[run.state]?.[0] === "bad" ? "bad" : "warn";
  const notice = (look, text) => h("p", { class: `notice ${look}` }, shape(look), h("span", {}, sentence(text)));
  return [...own.map((text) => notice(kind, text)), ...(run.warnings ?? []).map((text) => notice("warn", text))];
}

function waiting(link, run, list, words) {
  const back = guarded("Take it off the mill", {
    words: "The program leaves the mill; nothing has been cut by it.",
    yes: "Take it off",
    act: () => words.during(() => link.toRun("abort")),
  });
  return [run.setup?.change && h("p", { class: "notice warn" }, shape("warn"), h("span", {}, `Before this pass: ${run.setup.change.words}.`)), list.node, back.node];
}

function finished(link, run, onNext) {
  const next = run.next && h("button", { type: "button", class: "primary", onclick: () => onNext(run) }, `Next: ${run.next.name}`);
  return h("p", { class: "row" }, next || "That was the last pass: the lens is milled.");
}
