/** A photograph of the wall, measured by the server: what is off, and what to do. The server does not store it. */
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { photograph } from "../lib/photograph.js";
import { jobName, sentence } from "../lib/words.js";
import { fold } from "./fold.js";

const INTRO = t("Photograph the lens's light in a dark room, all of it and some dark wall around, not too bright; the answer says what is off.");
const NEEDS = ["heightfield.npz", "map.npz"]; // there once the lens is made

/** {node, update(job, artifacts)} */
export function photoPart() {
  let job = null;
  const photo = photograph({
    address: () => `/v1/jobs/${encodeURIComponent(job.id)}/photos`,
    lines: (answer) => answer.findings.map((one) => sentence(one.text)),
    alt: () => t`The photograph, straightened, beside the prediction for ${jobName(job)}, and their difference`,
  });
  const node = fold("photo", t("Photograph of the wall"), h("p", { class: "dim" }, INTRO), h("div", { class: "row" }, photo.button), photo.node);
  return {
    node,
    update(next, artifacts) {
      job = next;
      node.hidden = !NEEDS.every((name) => artifacts.has(name));
    },
  };
}
