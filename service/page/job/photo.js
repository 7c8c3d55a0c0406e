/** A photograph of the wall, looked at by the server: what is off, and what to do. Nothing is kept of it. */
import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { jobName, sentence } from "../lib/words.js";

const INTRO = "Photograph the lens's light in a dark room, all of it and some dark wall around, not too bright; this says what is off.";
const BUSY = "Looking at the photograph…";
const NEEDS = ["heightfield.npz", "map.npz"]; // there once the lens is made

/** {node, update(job, artifacts)} */
export function photoPart() {
  const said = h("p", { class: "photo-said", "aria-live": "polite" });
  const found = h("ul", { class: "photo-findings" });
  const picture = h("img", { class: "photo-picture", alt: "", hidden: true });
  const input = h("input", { type: "file", accept: "image/*", capture: "environment", hidden: true, onchange: chosen });
  const button = h("button", { type: "button", onclick: () => input.click() }, "Take or choose a photograph");
  const node = h(
    "section", { class: "card job-photo", "aria-labelledby": "photo-title", hidden: true },
    h("h2", { id: "photo-title" }, "Photograph of the wall"),
    h("p", { class: "dim" }, INTRO), h("div", { class: "row" }, button, input), said, found, picture,
  );
  let job = null;

  function chosen() {
    const [file] = input.files;
    input.value = ""; // the same file may be chosen again
    if (file) look(file);
  }
  async function look(file) {
    const form = new FormData();
    form.append("photo", file);
    button.disabled = true;
    show(BUSY, [], "");
    try {
      if (!(await api.need("jobs:write"))) return show("", [], "");
      const told = await api.upload(`/v1/jobs/${encodeURIComponent(job.id)}/photos`, form, { quiet: true });
      show("", told.findings.map((one) => one.text), `data:image/png;base64,${told.picture}`);
    } catch (error) {
      show(sentence(error.detail ?? error.message), [], "");
    } finally {
      button.disabled = false;
    }
  }
  function show(words, findings, address) {
    write(said, words);
    said.hidden = !words;
    replace(found, findings.map((text) => h("li", {}, sentence(text))));
    found.hidden = findings.length === 0;
    picture.hidden = !address;
    picture.alt = address ? `The photograph, set straight, beside what was foretold of ${jobName(job)}, and their difference` : "";
    if (address) picture.src = address;
    else picture.removeAttribute("src");
  }
  show("", [], "");
  return {
    node,
    update(next, artifacts) {
      job = next;
      node.hidden = !NEEDS.every((name) => artifacts.has(name));
    },
  };
}
