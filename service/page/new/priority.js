/** Which jobs come first; not part of the spec. */

import { row } from "./row.js";

const FIELD = {
  key: "priority",
  label: "Turn among waiting jobs",
  kind: "choice",
  usual: "normal",
  choices: [
    ["high", "before others"],
    ["normal", "in order"],
    ["low", "after others"],
  ],
};

export function priorityRow() {
  const made = row(FIELD, { onChange: () => {} });
  return { element: made.element, read: () => made.read() ?? "normal" };
}
