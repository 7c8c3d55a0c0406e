/** Tools for the picture, besides choosing its part: turn, mirror, tones. */

import { freshId, h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { MOST_ZOOM, UNTOUCHED } from "./picture.js";

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
