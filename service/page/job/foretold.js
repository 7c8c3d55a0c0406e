/** What was foretold of the jobs that this page has sent; it forgets when it is loaded again. */

const known = new Map();

/** Keeps the PSNR that a job's estimate came to, in dB. */
export function foretell(jobId, psnrDb) {
  if (Number.isFinite(psnrDb)) known.set(jobId, psnrDb);
}

/** The PSNR to be expected of a job's milled lens, by its plan or else by its estimate; undefined where none is known. */
export function foretoldOf(job) {
  return job.report?.plan?.psnr_db ?? known.get(job.id);
}
