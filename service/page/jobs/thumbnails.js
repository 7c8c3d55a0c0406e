/** Small pictures of jobs, fetched when they come into sight. */

import { api } from "../lib/api.js";

const SMALL = "thumbnail.png";
const WANTED = [SMALL, "target.png"];

/** {show(image, job), forget(image), close()}: fills image elements; `close` gives everything back. */
export function thumbnails() {
  const wanted = new WeakMap(); // image -> job
  const shown = new Map(); // image -> path
  const sight = new IntersectionObserver(
    (entries) => {
      for (const { isIntersecting, target } of entries) if (isIntersecting) fetchInto(target);
    },
    { rootMargin: "200px" },
  );

  async function fetchInto(image) {
    const job = wanted.get(image);
    sight.unobserve(image);
    if (!job || shown.has(image)) return;
    shown.set(image, null);
    try {
      const { artifacts } = await api.get(job.links.artifacts);
      const names = new Set(artifacts.map((file) => file.name));
      const name = WANTED.find((one) => names.has(one));
      if (!name) return shown.delete(image); // asked again when the job has changed
      const path = `${job.links.artifacts}/${name}`;
      shown.set(image, path);
      image.src = await api.blob(path);
      image.classList.add("there");
    } catch {
      forget(image); // a picture is no reason for an alarm
    }
  }

  function show(image, job) {
    wanted.set(image, job);
    if (!shown.has(image) && mayHave(job)) sight.observe(image);
  }

  function forget(image) {
    const path = shown.get(image);
    if (path) api.release(path);
    shown.delete(image);
    sight.unobserve(image);
  }

  return {
    show,
    forget,
    close() {
      sight.disconnect();
      for (const image of [...shown.keys()]) forget(image);
    },
  };
}

/** Not before the picture has been read. */
function mayHave(job) {
  return job.state !== "queued" && !(job.state === "running" && job.progress === 0);
}
