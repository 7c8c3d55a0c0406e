/** What happened at the mill, and a line said to it while it stands. */

import { h, write } from "../lib/dom.js";
import { enable, said } from "./said.js";
import { plain, RUN_WORDS, stateWord, whyNot } from "./words.js";

const SHOWN = 200;

export function terminal(link) {
  const words = said();
  const lines = h("ol", { class: "log", tabIndex: 0, "aria-label": "What happened at the mill" });
  const empty = h("p", { class: "dim" }, "Nothing yet.");
  const text = h("input", { type: "text", maxLength: 78, autocomplete: "off", autocapitalize: "characters", spellcheck: false, placeholder: "G0 X0 Y0" });
  const send = h("button", { type: "submit" }, "Send");
  const submit = async (event) => {
    event.preventDefault();
    if (text.value.trim() && (await words.during(() => link.order("block", { text: text.value.trim() })))) text.value = "";
  };
  const form = h("form", { class: "say", onsubmit: submit }, h("label", { class: "field" }, h("span", {}, "One line to the mill"), text), send);
  const node = h("section", { class: "card terminal", "aria-labelledby": "terminal-title" }, h("h2", { id: "terminal-title" }, "Console"), empty, lines, form, words.node);
  let last = null;
  return {
    node,
    update() {
      const newest = link.log.at(-1) ?? null;
      if (newest !== last) show(lines, link.log, last);
      last = newest;
      empty.hidden = link.log.length > 0;
      lines.hidden = link.log.length === 0;
      const why = whyNot(link);
      enable([text, send], why === "" && !link.busy);
    },
  };
}

/** Adds what is new; stays at the end where the reader was there. */
function show(list, log, last) {
  const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
  for (const entry of log.slice(log.indexOf(last) + 1)) list.append(line(entry));
  while (list.children.length > SHOWN) list.firstChild.remove();
  if (atEnd) list.scrollTop = list.scrollHeight;
}

function line(entry) {
  const clock = new Date(entry.at_s * 1000).toLocaleTimeString([], { hour12: false });
  const item = h("li", { class: `log-${entry.kind}` });
  item.append(h("time", {}, clock), " ", h("span", {}));
  write(item.lastChild, entry.kind === "state" ? stateWord(entry.words) : told(entry.words));
  return item;
}

function told(words) {
  return plain(words).replace(/: parked$/, `: ${RUN_WORDS.parked[1]}`);
}
