/** Small pictures of jobs, fetched when they come into sight. */

import { api } from "../lib/api.js";

/** {show(image, job), forget(image), close()}: fills image elements; `close` gives everything back. */
export function thumbnails() {
  const wanted = new WeakMap(); // image -> job
  const shown = new Map(); // image -> path of its picture
  const sight = new IntersectionObserver(
    (entries) => {
      for (const { isIntersecting, target } of entries) if (isIntersecting) fetchInto(target);
    },
    { rootMargin: "200px" },
  );

  /** Another picture of the same job takes the place of the one before once it is there. */
  async function fetchInto(image) {
    const job = wanted.get(image);
    const before = shown.get(image);
    sight.unobserve(image);
    if (!job || before === job.links.picture) return;
    shown.set(image, job.links.picture);
    try {
      image.src = await api.blob(job.links.picture);
      image.classList.add("there");
      if (before) api.release(before);
    } catch {
      forget(image); // a missing picture needs no error message
    }
  }

  function show(image, job) {
    wanted.set(image, job);
    if (job.links.picture && shown.get(image) !== job.links.picture) sight.observe(image);
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
