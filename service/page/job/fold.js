/** A part of a job's page behind its heading. */
import { h } from "../lib/dom.js";

/** A section that unfolds; its heading has the id "ID-title". */
export function fold(id, words, ...content) {
  const title = h("h2", { id: `${id}-title` }, words);
  return h("section", { class: `card folded ${id}-part`, "aria-labelledby": title.id }, h("details", {}, h("summary", {}, title), content));
}

/** Unfold it. */
export function unfold(node) {
  node.querySelector("details").open = true;
}
