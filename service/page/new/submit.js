/** Sends a job to the server once, however often the button is pressed or an answer is lost. */

import { api } from "../lib/api.js";
import { freshKey } from "../lib/words.js";

/** {send({blob, name}, spec, priority) -> job}. The same request keeps its key: the server makes one job of it. */
export function sender({ onWait }) {
  let last = { request: "", key: "" };
  let running = null;

  function send(picture, spec, priority) {
    running ??= deliver(picture, spec, priority).finally(() => {
      running = null;
    });
    return running;
  }

  async function deliver(picture, spec, priority) {
    const text = JSON.stringify(spec);
    const request = [await digest(picture.blob), picture.name, text, priority].join("\n");
    if (request !== last.request) last = { request, key: freshKey() };
    for (;;) {
      try {
        return await api.upload("/v1/jobs", jobForm(picture, text, priority), {
          headers: { "Idempotency-Key": last.key },
        });
      } catch (error) {
        if (error.status !== 0) throw error;
        onWait(true);
        await waitForServer();
        onWait(false);
      }
    }
  }

  return { send };
}

/** The form data of jobs and estimates. */
export function jobForm(picture, specText, priority = "normal") {
  const form = new FormData();
  form.append("spec", specText);
  if (priority !== "normal") form.append("priority", priority);
  form.append("image", picture.blob, picture.name);
  return form;
}

/** Resolves when the server answers again. */
function waitForServer() {
  return new Promise((done) => {
    if (!api.away) return done();
    const stop = api.onAway((away) => {
      if (away) return;
      stop();
      done();
    });
  });
}

/** Enough to tell two pictures apart; not for safety. crypto.subtle is there in secure contexts only. */
export async function digest(blob) {
  const bytes = new Uint8Array(await blob.arrayBuffer());
  let sum = 0x811c9dc5;
  for (let at = 0; at < bytes.length; at += 1) sum = Math.imul(sum ^ bytes[at], 0x01000193);
  return `${bytes.length}-${sum >>> 0}`;
}
