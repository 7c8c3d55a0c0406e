/** The picture of the camera beside the mill, one a second while it is unfolded and visible. Nothing if there is none. */

import { api } from "../lib/api.js";
import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";

const EVERY_MS = 1000;
const AGAIN_MS = 5000; // after a failure
const TIMEOUT_MS = 10_000;

export function camera(link) {
  const picture = h("img", { alt: t("The mill, as its camera sees it"), hidden: true });
  const said = h("p", { class: "dim", role: "status" });
  const fold = h("details", { open: true, ontoggle: () => look() }, h("summary", {}, h("h2", { id: "camera-title" }, t("Camera"))), picture, said);
  const node = h("section", { class: "card camera", "aria-labelledby": "camera-title", hidden: true }, fold);
  const now = { timer: 0, asking: false, closed: false }, change = blobPicture(picture);
  const isWanted = () => !now.closed && !node.hidden && fold.open && !document.hidden;

  async function look() {
    clearTimeout(now.timer);
    now.timer = 0;
    if (now.asking || !isWanted()) return;
    now.asking = true;
    const wait_ms = (await show()) ? EVERY_MS : AGAIN_MS;
    now.asking = false;
    if (isWanted()) now.timer = setTimeout(look, wait_ms);
  }

  async function show() {
    try {
      const response = await api.request("GET", link.machine.links.camera, { timeout_ms: TIMEOUT_MS, quiet: true });
      const blob = await response.blob();
      if (!now.closed) change(blob);
      write(said, "");
      return true;
    } catch {
      change(null); // an old picture could be mistaken for the present state
      write(said, t("The camera does not answer with a picture."));
      return false;
    }
  }

  document.addEventListener("visibilitychange", look);
  return {
    node,
    update() {
      node.hidden = !link.machine?.links?.camera;
      if (!now.timer) look();
    },
    close() {
      now.closed = true;
      clearTimeout(now.timer);
      document.removeEventListener("visibilitychange", look);
      change(null);
    },
  };
}

/** Shows pictures that come as blobs in an img, null for none: (blob) => void. */
export function blobPicture(img) {
  let url = "";
  return (blob) => {
    if (url) URL.revokeObjectURL(url);
    url = blob ? URL.createObjectURL(blob) : "";
    img.hidden = !url;
    if (url) img.src = url;
    else img.removeAttribute("src");
  };
}
