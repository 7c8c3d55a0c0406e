/** Starts a new job from another one: its picture and spec, perhaps with another of its plans. */

import { api } from "../lib/api.js";
import { t } from "../lib/language.js";
import { jobName } from "../lib/words.js";
import { merged } from "./spec.js";

/** {file, name, spec, notice}; plan: number of a row of the job's plan. */
export async function sourceOf(id, plan) {
  const asked = await api.get(`/v1/jobs/${encodeURIComponent(id)}/request`);
  const response = await api.request("GET", asked.image, { timeout_ms: 0 });
  const file = new File([await response.blob()], asked.name);
  const name = jobName(asked);
  const row = plan === undefined ? null : await planRow(id, Number(plan));
  if (!row)
    return {
      file,
      name,
      spec: asked.spec,
      notice: t`A copy of “${name}”. Change what you like; the other job stays as it is.`,
    };
  const spec = { ...merged(asked.spec, row.spec), preset: "recommended" };
  return { file, name, spec, notice: t`A copy of “${name}” with another plan: ${row.words}.` };
}

async function planRow(id, number) {
  const { report } = await api.get(`/v1/jobs/${encodeURIComponent(id)}`);
  return report?.plan?.candidates?.[number] ?? null;
}
