/** The side of the picture: where it is dropped, then what the wall will show of it, and what can be done to it. */

import { h, replace, write } from "../lib/dom.js";
import { dropPlace, invitation } from "./drop.js";
import { openPicture, sentPicture, UNTOUCHED } from "./picture.js";
import { screenOf } from "./screen.js";
import { pictureTools } from "./tools.js";
import { wall } from "./wall.js";

const SPREAD = Math.SQRT2; // the blur of an estimate is over both axes
const HOW = "What the wall will show. Drag to choose the part, pinch or use the slider to zoom.";

/**
 * {element, begin({picture, edits, name, file}), has(), draw(), showBlur(mm), blame(words), fault(), focus(), sent(), draft()}.
 * spec() is what the form holds; values: its rows that belong to the picture; onChange(): something else is to be sent.
 */
export function pictureSide({ spec, values, onChange }) {
  const now = { picture: null, edits: { ...UNTOUCHED }, blur_mm: 0 };
  const seen = wall({ state: readDrawing, onEdit: edit });
  const tools = pictureTools({ state: readDrawing, onEdit: edit });
  const name = h("input", { type: "text", maxLength: 80, autocomplete: "off", oninput: onChange });
  const marks = h("input", { type: "checkbox", checked: true, onchange: () => seen.draw() });
  const blur = h("label", { class: "tick", hidden: true }, marks, "With the blur that the tool's marks will leave");
  const own = h("div", { class: "picture-values" }, values);
  const place = h("div", { class: "stack tight" });
  const fault = h("p", { class: "fault", role: "alert" });

  /** All that the wall shows. */
  function readDrawing() {
    const screen = screenOf(spec());
    const share = now.blur_mm / SPREAD / screen.width_mm;
    return { ...now, screen, blurShare: marks.checked && share > 0 && share < 1 ? share : 0 };
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
    else if (file) await take(file, called);
    else replace(place, dropPlace({ words: invitation(), onFile: take }));
  }

  async function take(file, called) {
    use(await openPicture(file), null, called);
    onChange();
  }

  function use(picture, edits, called) {
    now.picture = picture;
    now.edits = { ...UNTOUCHED, ...edits };
    name.value = called ?? stem(picture.file.name);
    write(fault, "");
    const words = `This browser cannot show ${picture.file.name}. It is sent as it is, and used if the server can read it.`;
    const shown = picture.shown
      ? [h("div", { class: "wall-frame" }, seen.element), h("small", {}, HOW), blur, tools.element]
      : h("p", { class: "notice unseen" }, h("span", {}, words));
    const title = h("label", { class: "field" }, h("span", {}, "Name of the job"), name);
    replace(place, shown, own, title, dropPlace({ words: "Another picture?", onFile: take, compact: true }));
    draw();
  }

  /** Once the server has looked at it, it is no open question any more. */
  function blame(words) {
    write(fault, words);
    for (const notice of place.querySelectorAll(".unseen")) notice.hidden = Boolean(words);
  }

  function showBlur(mm) {
    now.blur_mm = mm;
    blur.hidden = !(mm > 0);
    seen.draw();
  }

  /** {blob, name} of what is to be sent; mostSide: a smaller copy will do. */
  async function sent(options) {
    const { blob, name: fileName } = await sentPicture(now.picture, now.edits, readDrawing().screen, options);
    const ending = /\.[^.]+$/.exec(fileName)?.[0] ?? "";
    return { blob, name: `${name.value.trim() || stem(fileName)}${ending}` };
  }

  return {
    element: h("section", { class: "picture-side", "aria-label": "Picture" }, fault, place),
    begin,
    has: () => now.picture !== null,
    draw,
    showBlur,
    blame,
    /** What is wrong with the picture, "" nothing that is known. */
    fault: () => fault.textContent,
    focus: () => place.querySelector("button, canvas")?.focus(),
    sent,
    draft: () => ({ picture: now.picture, edits: now.edits, name: name.value }),
  };
}

function stem(fileName) {
  return fileName.replace(/\.[^.]*$/, "");
}
