/** The pictures that were kept of the shown run, one after the other. Nothing where there is no camera. Fetched when unfolded. */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { locale, t } from "../lib/language.js";
import { blobPicture } from "./camera.js";
import { refusalLine } from "./order_controls.js";

const EVERY_MS = 120;

export function timelapse(link) {
  const words = refusalLine();
  const picture = h("img", { alt: t("The mill while the program ran"), hidden: true });
  const when = h("p", { class: "dim" });
  const place = h("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": t("Picture"), oninput: () => (stop(), show()) });
  const play = h("button", { type: "button", onclick: () => (now.timer ? stop() : start()) }, t("Play"));
  const bar = h("div", { class: "row", hidden: true }, play, place);
  const fold = h("details", { ontoggle: () => (fold.open ? words.run(look) : stop()) }, h("summary", {}, h("h2", { id: "timelapse-title" }, t("Timelapse"))), picture, bar, when, words.node);
  const node = h("section", { class: "card folded timelapse", "aria-labelledby": "timelapse-title", hidden: true }, fold);
  const now = { run: "", pictures: [], timer: 0, shown: 0 }, change = blobPicture(picture);

  async function look() {
    const { id, links } = link.run;
    const { pictures } = await api.get(links.timelapse);
    if (now.run !== id) return;
    now.pictures = pictures;
    place.max = Math.max(0, pictures.length - 1);
    place.value = place.max;
    bar.hidden = pictures.length < 2;
    if (pictures.length) await show();
    else write(when, t("No picture has been kept of this program."));
  }

  async function show() {
    const wanted = now.pictures[place.value];
    now.shown += 1;
    const turn = now.shown;
    const response = await api.request("GET", wanted.url, { quiet: true }).catch(() => null); // it may have made room meanwhile
    const blob = await response?.blob();
    if (!blob || turn !== now.shown) return;
    change(blob);
    write(when, new Date(wanted.at).toLocaleString(locale, { dateStyle: "medium", timeStyle: "short", hourCycle: "h23" }));
  }

  function start() {
    write(play, t("Pause"));
    if (place.value === place.max) place.value = 0;
    else place.value = Number(place.value) + 1;
    now.timer = setTimeout(next, EVERY_MS);
    show();
  }

  async function next() {
    if (Number(place.value) >= Number(place.max)) return stop();
    place.value = Number(place.value) + 1;
    await show();
    if (now.timer) now.timer = setTimeout(next, EVERY_MS);
  }

  function stop() {
    clearTimeout(now.timer);
    now.timer = 0;
    write(play, t("Play"));
  }

  return {
    node,
    update() {
      const { run, machine } = link;
      node.hidden = !machine?.links?.camera || !run?.started_at;
      if (run?.id === now.run) return;
      Object.assign(now, { run: run?.id ?? "", pictures: [] });
      fold.open = false;
      stop();
      change(null);
    },
    close() {
      stop();
      change(null);
    },
  };
}
