/** Words for how alike picture and target look, from `seen_db`; thresholds as in service/wording.py. */

import { t } from "../lib/language.js";

const EYE = [
  [50, t("no eye can tell it from the target")],
  [36, t("very close to the target")],
  [27, t("small differences, seen only side by side")],
  [16, t("plainly the picture; fine detail or tones are off")],
  [9, t("recognisable, visibly soft or uneven")],
  [-Infinity, t("hard to recognise")],
];

/** Whether the picture will be hard to recognise. */
export function isHard(seenDb) {
  return seenDb < EYE.at(-2)[0];
}

/** Whether a person sees differences from the picture only beside it. */
export function isFine(seenDb) {
  return seenDb >= EYE[2][0];
}

/** "94 % alike": the correlation of picture and target; more digits where more of them are nines. */
export function alikeWords(seenDb) {
  const percent = 100 * (1 - 10 ** (-seenDb / 10)), places = percent < 97 ? 0 : percent < 99.7 ? 1 : 2;
  return t`${Math.max(0, Math.floor(percent * 10 ** places) / 10 ** places)} % alike`;
}

/** The word for a likeness. */
export function eyeWords(seenDb) {
  return EYE.find(([least]) => seenDb >= least)?.[1] ?? t("not known");
}

/** Likenesses, in dB, of the jobs that this page has sent; forgotten when the page is loaded again. */
const known = new Map();

/** Keep the likeness of a job's estimate, in dB. */
export function keepPrediction(jobId, seenDb) {
  if (Number.isFinite(seenDb)) known.set(jobId, seenDb);
}

/** Return the predicted likeness of a job's milled lens, from its plan or its estimate; undefined if neither is known. */
export function predictedLikeness(job) {
  return job.report?.plan?.seen_db ?? known.get(job.id);
}
