/** What was predicted of jobs: the likeness of picture and target. */

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
