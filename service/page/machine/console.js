/** The mill's log, and a field to send it a line while it stands. */

import { h, replace } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { askIn, enable, refusalLine } from "./order_controls.js";
import { logWords, refusal, whyNot } from "./words.js";

const SHOWN = 200;

export function terminal(link) {
  const words = refusalLine();
  const lines = h("ol", { class: "log", tabIndex: 0, "aria-label": t("What happened at the mill") });
  const empty = h("p", { class: "dim" }, t("Nothing yet."));
  const text = h("input", { type: "text", maxLength: 78, autocomplete: "off", autocapitalize: "characters", spellcheck: false, placeholder: "G0 X0 Y0" });
  const send = h("button", { type: "submit" }, t("Send"));
  const question = h("div", { class: "ask" });

  function submit(event) {
    event.preventDefault();
    if (text.value.trim()) give({ text: text.value.trim() });
  }

  async function give(body) {
    replace(question);
    await words.run(async () => {
      try {
        await link.order("block", body);
        text.value = "";
      } catch (error) {
        if (error.code !== "confirm") throw error;
        askAgain(body, error);
      }
    });
  }

  /** A line that changes a property of the mill, such as the end of its travel, needs a second press. */
  function askAgain(body, error) {
    const cancel = () => (replace(question), text.focus());
    const go = () => give({ ...body, confirm: true });
    askIn(question, t`Send ${body.text}`, { words: refusal(error), yes: t`Send ${body.text} anyway`, go, cancel });
  }

  const form = h("form", { class: "say", onsubmit: submit }, h("label", { class: "field" }, h("span", {}, t("One line to the mill")), text), send);
  const node = h("section", { class: "card terminal", "aria-labelledby": "terminal-title" }, h("h2", { id: "terminal-title" }, t("Console")), empty, lines, form, question, words.node);
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

/** Append new lines; stay at the end if the reader was there. */
function show(list, log, last) {
  const atEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 40;
  for (const entry of log.slice(log.indexOf(last) + 1)) list.append(line(entry));
  while (list.children.length > SHOWN) list.firstChild.remove();
  if (atEnd) list.scrollTop = list.scrollHeight;
}

function line(entry) {
  const when = new Date(entry.at_s * 1000);
  const clock = when.toLocaleTimeString(locale, { hour12: false });
  const item = h("li", { class: `log-${entry.kind}` });
  item.append(h("time", { dateTime: when.toISOString() }, clock), " ", h("span", {}, logWords(entry)));
  if (entry.by) item.append(" ", h("small", {}, entry.by));
  return item;
}
