/** The picture's side of the form: the place to drop it, then its light on the wall, and the tools to change it. */

import { freshId, h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { eyeWords, isFine } from "../job/eye_words.js";
import { putAway } from "./draft.js";
import { darkRoom, dropPlace } from "./drop.js";
import { MOST_ZOOM, openPicture, sentPicture, UNTOUCHED } from "./picture.js";
import { screenOf } from "./screen.js";
import { wall } from "./wall.js";

const NOT_YET = t("the picture as asked for: its light is not worked out yet");
const NO_LIGHT = t("no pass finishes the lens: the wall shows no picture");
const HOW = t("drag to choose the part, pinch or + and − to zoom");

/**
 * {element, tools, begin({picture, edits, name, file}), has(), forget(), show(estimate, first), blame(words), fault(), focus(), sent(),
 * draft()}: the two pictures, and the tools to change them. spec(): the content of the form; values: its rows that belong to the picture; plans: the element below both pictures; onChange(): the content to send has changed;
 * onOpening(name): a picture is being read, which may take a moment.
 */
export function pictureSide({ spec, values, plans, onChange, onOpening }) {
  const now = { picture: null, edits: { ...UNTOUCHED }, estimate: null, light: null };
  const seen = wall({ state: readDrawing, onEdit: edit });
  const tools = pictureTools({ state: readDrawing, onEdit: edit });
  const name = h("input", { type: "text", maxLength: 80, autocomplete: "off", oninput: onChange });
  const title = h("label", { class: "field" }, h("span", {}, t("Name of the job")), name);
  const all = h("div", { class: "stack tight", hidden: true }, tools.element, values, title);
  const place = h("div", { class: "stack tight" });
  const fault = h("p", { class: "fault", role: "alert" });
  const wallNote = h("small", { class: "told" }, NOT_YET);

  function readDrawing() {
    return { ...now, screen: screenOf(spec()) };
  }

  function edit(edits) {
    now.edits = edits;
    draw();
    onChange();
  }

  function draw() {
    tools.update();
    seen.draw();
  }

  async function begin({ picture, edits, name: called, file }) {
    if (picture) use(picture, edits, called);
    else if (file) await take(file, called, edits);
    else replace(place, darkRoom(take));
  }

  async function take(file, called, edits) {
    place.setAttribute("aria-busy", "true"); // a huge one takes its time
    onOpening(file.name);
    try {
      use(await openPicture(file), edits, called);
    } finally {
      place.removeAttribute("aria-busy");
    }
    onChange();
  }

  function use(picture, edits, called) {
    now.picture = picture;
    putAway(picture.file);
    now.edits = { ...UNTOUCHED, ...edits };
    name.value = called ?? stem(picture.file.name);
    write(fault, "");
    const words = t`This browser cannot show ${picture.file.name}. It is sent as it is, and used if the server can read it.`;
    const figure = (canvas, caption, more) => h("figure", {}, canvas, h("figcaption", {}, h("strong", {}, caption), more));
    const shown = picture.shown
      ? h("div", { class: "stage" }, figure(seen.picture, t("Picture"), h("small", {}, HOW)), figure(seen.wall, t("On the wall"), wallNote), plans)
      : h("p", { class: "notice unseen" }, h("span", {}, words));
    all.hidden = false;
    tools.element.hidden = !picture.shown;
    replace(place, shown, dropPlace({ words: t("Another picture?"), onFile: take, compact: true }));
    draw();
  }

  /** The server has checked the picture, so its question is settled. */
  function blame(words) {
    write(fault, words);
    for (const notice of place.querySelectorAll(".unseen")) notice.hidden = Boolean(words);
  }

  /** The settings have changed: the last light no longer belongs to them. */
  function forget() {
    Object.assign(now, { estimate: null, light: null });
    write(wallNote, NOT_YET);
    draw();
  }

  async function show(estimate, first) {
    now.estimate = estimate;
    const light = estimate.wall && Object.assign(new Image(), { src: estimate.wall });
    await light?.decode();
    if (now.estimate !== estimate) return; // something was changed meanwhile
    now.light = light;
    wallNote.classList.toggle("fine", !first && isFine(estimate.seen_db));
    write(wallNote, !light ? NO_LIGHT : first ? t("a first look") : eyeWords(estimate.seen_db));
    seen.draw();
  }

  /** {blob, name} of the picture to send; mostSide: a smaller copy is enough. */
  async function sent(options) {
    const { blob, name: fileName } = await sentPicture(now.picture, now.edits, readDrawing().screen, options);
    const ending = /\.[^.]+$/.exec(fileName)?.[0] ?? "";
    return { blob, name: `${name.value.trim() || stem(fileName)}${ending}` };
  }

  return {
    element: h("section", { class: "picture-side", "aria-label": t("Picture") }, fault, place),
    tools: all,
    begin,
    has: () => now.picture !== null,
    forget,
    show,
    blame,
    /** The fault of the picture; "" if none is known. */
    fault: () => fault.textContent,
    focus: () => place.querySelector("button, canvas")?.focus(),
    sent,
    draft: () => ({ picture: now.picture, edits: now.edits, name: name.value }),
  };
}

function stem(fileName) {
  return fileName.replace(/\.[^.]*$/, "");
}

/** {element, update()}. state() -> {edits, screen}; onEdit(edits). */
export function pictureTools({ state, onEdit }) {
  const change = (part) => onEdit({ ...state().edits, ...part });
  const turn = (by) => {
    const { quarters, x, y, mirror } = state().edits;
    const [across, down] = by === 1 ? [1 - y, x] : [y, 1 - x];
    change({ quarters: (quarters + (mirror ? 4 - by : by) + 4) % 4, x: across, y: down });
  };
  const mirror = h(
    "button",
    {
      type: "button",
      "aria-pressed": "false",
      onclick: () => change({ mirror: !state().edits.mirror, x: 1 - state().edits.x }),
    },
    t("Mirror"),
  );
  const zoom = slider(t("Zoom"), { min: 0, max: Math.log(MOST_ZOOM), step: 0.01 }, (value) =>
    change({ zoom: Math.exp(value) }),
  );
  const brightness = slider(t("Brightness"), { min: -1, max: 1, step: 0.02 }, (value) => change({ brightness: value }));
  const contrast = slider(t("Contrast"), { min: -1, max: 1, step: 0.02 }, (value) => change({ contrast: value }));
  const reset = h("button", { type: "button", onclick: () => onEdit({ ...UNTOUCHED }) }, t("As it was"));
  const element = h(
    "div",
    { class: "stack tight" },
    h(
      "div",
      { class: "row tools" },
      h("button", { type: "button", onclick: () => turn(3) }, t("Turn left")),
      h("button", { type: "button", onclick: () => turn(1) }, t("Turn right")),
      mirror,
      reset,
    ),
    h("div", { class: "sliders" }, zoom.element, brightness.element, contrast.element),
  );

  function update() {
    const { edits, screen } = state();
    mirror.setAttribute("aria-pressed", String(edits.mirror));
    zoom.show(Math.log(edits.zoom));
    zoom.element.hidden = screen.fit !== "crop";
    brightness.show(edits.brightness);
    contrast.show(edits.contrast);
  }

  return { element, update };
}

function slider(words, range, onInput) {
  const id = freshId("slider");
  const input = h("input", { type: "range", id, ...range, oninput: () => onInput(Number(input.value)) });
  const element = h("div", { class: "slider" }, h("label", { for: id }, words), input);
  const show = (value) => {
    if (Number(input.value) !== value) input.value = String(value);
  };
  return { element, show };
}
