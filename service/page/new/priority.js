/** The priority of a job in the queue; not part of the spec. */

import { t } from "../lib/language.js";
import { row } from "./row.js";

const FIELD = {
  key: "priority",
  label: t("Turn among waiting jobs"),
  kind: "choice",
  usual: "normal",
  choices: [
    ["high", t("before others")],
    ["normal", t("in order")],
    ["low", t("after others")],
  ],
};

export function priorityRow() {
  const made = row(FIELD, { onChange: () => {} });
  return { element: made.element, read: () => made.read() ?? "normal" };
}
