/** The orders given to a mill and their results: newest first, older ones on demand. Fetched while it is unfolded. */

import { api } from "../lib/api.js";
import { h, replace } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { enable, refusalLine } from "./order_controls.js";
import { logWords } from "./words.js";

const PAGE = 25;

export function ordersGiven(link) {
  const words = refusalLine();
  const rows = h("ol", { class: "given", tabIndex: 0, "aria-label": t("Orders and stops") });
  const older = h("button", { type: "button", onclick: () => words.run(() => add(next)) }, t("Show older ones"));
  const fold = h("details", { ontoggle: () => look() }, h("summary", {}, h("h2", { id: "given-title" }, t("Orders"))), rows, older, words.node);
  const node = h("section", { class: "card folded orders", "aria-labelledby": "given-title" }, fold);
  let next = null;
  let seen = ""; // newest entry of the log at the last request
  older.hidden = true;

  function look() {
    const now = `${link.commands} ${link.machine?.run?.state} ${link.machine?.mill?.state}`;
    if (!fold.open || now === seen) return;
    seen = now;
    words.run(() => add(null));
  }

  /** Add the orders before this number; without a number, replace all by the newest ones. */
  async function add(before) {
    const found = await api.get(`${link.path}/orders?limit=${PAGE}${before ? `&before=${before}` : ""}`);
    const made = found.orders.map(row);
    if (before) rows.append(...made);
    else replace(rows, made.length ? made : h("li", { class: "dim" }, t("Nobody has sent this mill an order yet.")));
    next = found.next;
    older.hidden = !next;
  }

  return {
    node,
    update() {
      look();
      enable([older], !link.away);
    },
  };
}

function row(entry) {
  const when = new Date(entry.at_s * 1000);
  const clock = `${when.toLocaleDateString(locale, { day: "numeric", month: "short" })} ${when.toLocaleTimeString(locale, { hour12: false })}`;
  const who = [entry.by, entry.from && t`from ${entry.from}`].filter(Boolean).join(" ");
  const bad = entry.kind === "fault" || entry.code === "order_refused";
  return h("li", { class: bad ? "refused" : "" }, h("time", { dateTime: when.toISOString() }, clock), " ", h("span", { class: "dim" }, who), h("span", {}, logWords(entry)));
}
