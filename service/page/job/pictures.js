/** Target, ideal caustic, caustic as milled and as finished: side by side, and any two over each other with a wipe. */
import { api } from "../lib/api.js";
import { freshId, h, replace } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { wipe } from "./wipe.js";

export const KINDS = [
  { name: "target.png", words: "Target", note: "what the light is to paint" },
  { name: "caustic.png", words: "Ideal caustic", note: "of the lens as designed" },
  { name: "caustic-as-milled.png", words: "As milled", note: "with all marks of the tool" },
  { name: "caustic-as-finished.png", words: "As finished", note: "after the work by hand: what the wall will show" },
];

const PREPARED = "prepared.png";

/** Pictures of artifacts as object URLs, each fetched once: {get(artifact) -> url, free()}. */
export function pictureShelf() {
  const held = new Map();
  return {
    get(artifact) {
      if (!held.has(artifact.url)) held.set(artifact.url, api.blob(artifact.url));
      return held.get(artifact.url);
    },
    free() {
      for (const [path, promise] of held) promise.then(() => api.release(path), () => {});
      held.clear();
    },
  };
}

/** {node, update(artifacts), free()} */
export function picturesPart() {
  const shelf = pictureShelf(), both = wipe();
  const row = h("div", { class: "pictures-row" }), given = h("div", { class: "pictures-given" });
  const left = chooser("Left", () => draw()), right = chooser("Right", () => draw());
  const compared = h("div", {}, both.node, h("div", { class: "wipe-choice" }, left.node, right.node));
  const wait = h("p", { class: "dim soon" }, "The pictures appear here as they are made.");
  const title = h("h2", { id: "pictures-title" }, "Pictures");
  const node = h("section", { class: "card", "aria-labelledby": "pictures-title" }, title, wait, compared, row, given);
  let there = [], key = "";

  async function update(artifacts) {
    const known = KINDS.filter(({ name }) => artifacts.has(name));
    const found = known.map((kind) => ({ ...kind, file: artifacts.get(kind.name) }));
    const prepared = artifacts.get(PREPARED);
    const next = [...found.map(({ file }) => file.sha256), prepared?.sha256].join();
    if (next === key && key) return;
    key = next;
    wait.hidden = found.length > 0;
    compared.hidden = found.length < 2;
    try {
      there = await Promise.all(found.map(async (kind) => ({ ...kind, url: await shelf.get(kind.file) })));
      replace(given, prepared && preparedFigure(await shelf.get(prepared)));
    } catch (error) {
      key = "";
      toast(`The pictures could not be loaded. ${error.detail ?? error.message}`, { kind: "bad" });
      return;
    }
    replace(row, there.map(figure));
    left.offer(there, 0);
    right.offer(there, there.length - 1);
    draw();
  }
  function draw() {
    const sides = [left, right].map((side) => there.find(({ name }) => name === side.value()));
    if (!sides[0] || !sides[1]) return;
    both.show(...sides.map(({ words, url, note }) => ({ words, url, alt: `${words}: ${note}` })));
  }
  return { node, update, free: shelf.free };
}

function figure({ words, note, url }) {
  const picture = h("img", { src: url, alt: `${words}: ${note}` });
  picture.addEventListener("load", () => picture.classList.toggle("coarse", picture.naturalWidth <= 256));
  const caption = h("figcaption", {}, h("strong", {}, words), " ", h("span", { class: "dim" }, note));
  return h("figure", {}, picture, caption);
}

/** The picture as a person gave it, beside what the lens aims at. */
function preparedFigure(url) {
  const words = "The picture as given, and prepared for what will show: contrast is raised in what is large enough.";
  return h("figure", {}, h("img", { src: url, alt: words }), h("figcaption", {}, words));
}

/** A list of pictures to choose one from, which keeps a person's choice. */
function chooser(words, onChange) {
  const id = freshId("picture");
  let own = false;
  const select = h("select", { id, onchange: () => ((own = true), onChange()) });
  return {
    node: h("label", { class: "field", for: id }, h("span", {}, words), select),
    value: () => select.value,
    offer(kinds, usual) {
      const before = select.value;
      replace(select, kinds.map(({ name, words: text }) => h("option", { value: name }, text)));
      const kept = own && kinds.some(({ name }) => name === before);
      select.value = kept ? before : kinds[usual]?.name;
    },
  };
}
