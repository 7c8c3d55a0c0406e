/** Every key of a job under its title, and a field that leaves only those whose words or key hold what is typed. */

import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";

/** An element; settings: [[title, element]]. */
export function allSettings(settings) {
  const parts = settings.map(([title, element]) => h("section", {}, h("h3", {}, title), element));
  const find = () => {
    const wanted = search.value.trim().toLowerCase(), lacks = (one) => !`${one.dataset.key ?? ""} ${one.textContent}`.toLowerCase().includes(wanted);
    for (const part of parts) {
      const rows = [...part.querySelectorAll(".fields > .field")];
      for (const one of rows) one.classList.toggle("unfound", lacks(one));
      part.classList.toggle("unfound", rows.length ? rows.every(lacks) : lacks(part));
    }
  };
  const search = h("input", { type: "search", placeholder: t("Search"), "aria-label": t("Search all settings"), oninput: find });
  return h("div", { class: "stack expert" }, search, parts);
}
