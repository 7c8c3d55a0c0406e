/** Sending: the bar at the foot with the estimate in one line, the button, and the reason if it is disabled; and the turn in the queue. */

import { freshId, h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { shape } from "../lib/state.js";
import { focusRow } from "./form.js";
import { row } from "./row.js";

const PRIORITY = {
  key: "priority",
  label: t("Turn among waiting jobs"),
  kind: "choice",
  usual: "normal",
  choices: [["high", t("before others")], ["normal", t("in order")], ["low", t("after others")]],
};
const MAKE = t("Make the lens");
const MOST_NAMED = 3; // problems that are named beside the button
const WAITS = t("The server does not answer. The job is sent as soon as it does; leave this page open.");

/** The row of the turn in the queue, which is not part of the spec. */
export function priorityRow() {
  return row(PRIORITY, { onChange: () => {} });
}

/** {element, say(words), blame(details), wait(waiting), isBusy(), busy(sending), ready(why, look), focus()}. */
export function submitBar(onclick) {
  const line = h("p", { class: "line" });
  const why = h("p", { class: "line why row", id: freshId("why") });
  const button = h("button", { type: "button", class: "primary big", "aria-describedby": why.id, onclick }, MAKE);
  const waits = h("p", { class: "notice warn", role: "status", hidden: true }, shape("warn"), h("span", {}, WAITS));
  const faults = h("div", { class: "stack tight", role: "alert" });
  const notice = (words) => h("p", { class: "notice bad" }, shape("bad"), h("span", {}, words));
  const now = { sending: false, why: "", look: [] };
  let listed = [];
  const name = (row) => h("button", { type: "button", class: "quiet", onclick: () => focusRow(row) }, row.field.label);
  function update() {
    button.setAttribute("aria-disabled", String(now.sending));
    button.disabled = now.why !== "" && !now.sending;
    write(button, now.sending ? t("Sending…") : MAKE);
    line.hidden = Boolean(now.why || now.look.length);
    why.hidden = !line.hidden;
    const more = now.look.length - MOST_NAMED, said = [now.why, ...now.look];
    if (said.length === listed.length && said.every((one, k) => one === listed[k])) return; // the focus stays
    listed = said;
    const names = now.look.slice(0, MOST_NAMED).map(name);
    replace(why, now.why, names.length > 0 && [" ", t("Look at:"), names, more > 0 && t`+ ${more} more`]);
  }
  return {
    element: h("div", { class: "submit-bar" }, faults, waits, h("div", { class: "row spread" }, line, why, button)),
    say: (words) => write(line, words),
    blame: (details) => replace(faults, details.map(notice)),
    wait: (waiting) => (waits.hidden = !waiting),
    isBusy: () => now.sending,
    busy: (sending) => ((now.sending = sending), update()),
    /** why: what is missing before it can be sent, "" nothing; look: the rows to look at. */
    ready: (why, look = []) => (Object.assign(now, { why, look }), update()),
    focus: () => button.focus(),
  };
}
