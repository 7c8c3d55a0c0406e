/** Two pictures of one size over each other; mouse, finger or keys move the line from which the right one shows. */
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";

const COARSE_PIXELS = 256;

/** {node, show(left, right)}; a side is {words, url, alt}. */
export function wipe() {
  const under = h("img", { class: "wipe-picture", alt: "", draggable: false });
  const over = h("img", { class: "wipe-picture wipe-over", alt: "", draggable: false });
  const names = [h("span", { class: "wipe-name" }), h("span", { class: "wipe-name wipe-name-right" })];
  const bar = h("div", { class: "wipe-bar", "aria-hidden": "true" });
  const frame = h("div", { class: "wipe-frame" }, under, over, bar, names);
  const range = h("input", { type: "range", min: 0, max: 100, step: 0.5, value: 50, class: "wipe-range", "aria-label": t("Wipe") });
  const node = h("div", { class: "wipe" }, frame, range);

  function set(percent) {
    range.value = percent;
    frame.style.setProperty("--at", `${range.value}%`);
    range.setAttribute("aria-valuetext", t`${names[0].textContent} on the left ${Math.round(range.value)} percent`);
  }
  function follow(event) {
    const box = frame.getBoundingClientRect();
    set(((event.clientX - box.left) / box.width) * 100);
  }
  frame.addEventListener("pointerdown", (event) => {
    if (event.button > 0) return;
    frame.setPointerCapture(event.pointerId);
    follow(event);
  });
  frame.addEventListener("pointermove", (event) => frame.hasPointerCapture(event.pointerId) && follow(event));
  range.addEventListener("input", () => set(range.value));
  for (const picture of [under, over]) {
    picture.addEventListener("load", () => {
      picture.classList.toggle("coarse", picture.naturalWidth <= COARSE_PIXELS);
      frame.classList.add("drawn");
      if (picture === under) frame.style.setProperty("--shape", picture.naturalWidth / picture.naturalHeight);
    });
  }
  set(50);

  return {
    node,
    show(left, right) {
      [[under, names[0], left], [over, names[1], right]].forEach(([picture, name, side]) => {
        if (picture.src !== side.url) picture.src = side.url;
        picture.alt = side.alt ?? side.words;
        name.textContent = side.words;
      });
      range.setAttribute("aria-label", t`Wipe between ${left.words} and ${right.words}`);
      set(range.value);
    },
  };
}
