/** Predicted PSNRs of the jobs that this page has sent; forgotten when the page is loaded again. */

const known = new Map();

/** Keep the PSNR of a job's estimate, in dB. */
export function keepPrediction(jobId, psnrDb) {
  if (Number.isFinite(psnrDb)) known.set(jobId, psnrDb);
}

/** Return the predicted PSNR of a job's milled lens, from its plan or its estimate; undefined if neither is known. */
export function predictedPsnr(job) {
  return job.report?.plan?.psnr_db ?? known.get(job.id);
}
