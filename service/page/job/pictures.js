/**
 * Pictures of the light, side by side, and any two over each other with a wipe; then the other pictures for the page.
 * service/job/report/pictures.py lists them and their titles.
 */
import { api } from "../lib/api.js";
import { freshId, h, replace, whenSeen } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { fold } from "./fold.js";
import { PICTURES } from "./report_pictures.js";
import { wipe } from "./wipe.js";

const shownAs = (where) =>
  PICTURES.filter(({ shown }) => shown === where).map((one) => ({ ...one, title: t(one.title), note: one.note && t(one.note) }));
export const ON_THE_WALL = shownAs("wall");
const BY_THEMSELVES = shownAs("page");

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
  const row = h("div", { class: "pictures-row" }), others = h("div", { class: "pictures-given" });
  const left = chooser(t("Left"), () => draw()), right = chooser(t("Right"), () => draw());
  const compared = h("div", {}, both.node, h("div", { class: "wipe-choice" }, left.node, right.node));
  const wait = h("p", { class: "dim soon" }, t("The pictures appear here as they are made."));
  const body = h("div", {}, compared, row, others), node = fold("pictures", t("Pictures"), wait, body);
  let there = [], key = "", files = new Map();
  const seen = whenSeen(body, load);

  function update(artifacts) {
    files = artifacts;
    wait.hidden = ON_THE_WALL.some(({ name }) => artifacts.has(name));
    seen.again();
  }
  async function load() {
    const artifacts = files;
    const made = (kinds) => kinds.map((kind) => ({ ...kind, file: artifacts.get(kind.name) })).filter(({ file }) => file);
    const found = made(ON_THE_WALL), further = made(BY_THEMSELVES);
    const next = [...found, ...further].map(({ file }) => file.sha256).join();
    if (next === key && key) return;
    key = next;
    compared.hidden = found.length < 2;
    try {
      there = await loaded(found);
      replace(others, (await loaded(further)).map(captioned));
    } catch (error) {
      key = "";
      toast(t`The pictures could not be loaded. ${error.detail ?? error.message}`, { kind: "bad" });
      return;
    }
    replace(row, there.map(figure));
    left.offer(there, 0);
    right.offer(there, there.length - 1);
    draw();
  }
  const loaded = (kinds) => Promise.all(kinds.map(async (kind) => ({ ...kind, url: await shelf.get(kind.file) })));
  function draw() {
    const sides = [left, right].map((side) => there.find(({ name }) => name === side.value()));
    if (!sides[0] || !sides[1]) return;
    both.show(...sides.map(({ title, url, note }) => ({ words: title, url, alt: `${title}: ${note}` })));
  }
  return { node, update, free: () => (seen.end(), shelf.free()) };
}

function figure({ title, note, url }) {
  const picture = h("img", { src: url, alt: `${title}: ${note}` });
  picture.addEventListener("load", () => picture.classList.toggle("coarse", picture.naturalWidth <= 256));
  const caption = h("figcaption", {}, h("strong", {}, title), " ", h("span", { class: "dim" }, note));
  return h("figure", {}, picture, caption);
}

function captioned({ title, url }) {
  return h("figure", {}, h("img", { src: url, alt: title }), h("figcaption", {}, title));
}

/** A drop-down list of pictures that keeps the person's choice when the list changes. */
function chooser(words, onChange) {
  const id = freshId("picture");
  let own = false;
  const select = h("select", { id, onchange: () => ((own = true), onChange()) });
  return {
    node: h("label", { class: "field", for: id }, h("span", {}, words), select),
    value: () => select.value,
    offer(kinds, usual) {
      const before = select.value;
      replace(select, kinds.map(({ name, title: text }) => h("option", { value: name }, text)));
      const kept = own && kinds.some(({ name }) => name === before);
      select.value = kept ? before : kinds[usual]?.name;
    },
  };
}
