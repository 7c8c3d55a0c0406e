/** The place where a picture is dropped, pasted, chosen or photographed. */

import { api } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { at } from "../lib/root.js";

const EXAMPLES = [["portrait.jpg", t("Portrait")], ["camera.jpg", t("Camera")], ["logo.png", t("Logo")], ["characters.png", t("Letters")]];
const KINDS = "image/png,image/jpeg,image/webp,image/tiff,image/bmp,image/gif,.tif,.tiff";

/** An element that calls onFile(File). words: what to do, in one sentence; more: what stands there, too.
 * @param {{words: string, onFile: (file: File) => void, compact?: boolean, more?: any}} options */
export function dropPlace({ words, onFile, compact = false, more }) {
  const take = (files) => {
    const file = [...files].find(isPicture);
    if (file) onFile(file);
    else if (files.length)
      toast(t("This is not a picture. Choose a PNG, JPEG, TIFF, WebP, BMP or GIF file."), { kind: "bad" });
  };
  const chosen = pick({ accept: KINDS }, take);
  const photographed = pick({ accept: "image/*", capture: "environment" }, take);
  async function photo() {
    if (isHandheld()) return photographed.click();
    const file = await (await import("./camera.js")).photograph();
    if (file && place.isConnected) onFile(file);
  }
  const choose = h("button", { type: "button", class: compact ? "" : "primary big", onclick: () => chosen.click() }, t("Choose a picture"));
  const shoot = h("button", { type: "button", class: compact ? "photo" : "photo big", hidden: !hasCamera(), onclick: photo }, t("Take a photo"));
  const place = h("div", { class: compact ? "drop compact" : "drop" }, h("p", {}, words), h("div", { class: "row" }, choose, shoot), chosen, photographed, more);
  receive(place, take);
  return place;
}

/** Where nobody has chosen a picture yet: a lens in a dark room, its light on the wall (docs/draw_focus.py computes it), and the place to drop a picture. light: "focus", which moves, or "focus-still". */
export function darkRoom(onFile, light = "focus-still") {
  const words = invitation(t(": your mill cuts it into a clear block, and light through that block paints it on the wall."));
  const picture = (name) => at(`/page/jobs/${name}.avif`);
  const still = h("source", { media: "(prefers-reduced-motion: reduce)", srcset: picture("focus-still") });
  const seen = h("img", { src: picture(light), alt: t("The light of a milled lens on a wall: an astronaut, smiling"), width: 416, height: 416 });
  const scene = h("div", { class: "room-scene" }, h("span", { class: "room-beam" }), h("picture", {}, still, seen), h("span", { class: "room-lens" }));
  return h("div", { class: "room" }, dropPlace({ words, onFile, more: gallery(onFile) }), scene);
}

/** Example pictures for people who have none at hand. */
function gallery(onFile) {
  const one = ([name, words]) => {
    const picture = h("img", { src: at(`/page/new/gallery/${name}`), alt: "", width: 88, height: 88 });
    return h("button", { type: "button", onclick: () => takeExample(picture.src, words + name.slice(name.lastIndexOf(".")), onFile) }, picture, words);
  };
  return h("div", { class: "gallery", role: "group", "aria-label": t("Examples") }, h("p", {}, t("Or try one of these")), EXAMPLES.map(one));
}

async function takeExample(address, name, onFile) {
  try {
    const blob = await (await api.request("GET", address)).blob();
    onFile(new File([blob], name, { type: blob.type }));
  } catch (error) {
    toast(error.detail ?? error.message, { kind: "bad" });
  }
}

/** The instruction; without "drop" on a touch screen. */
export function invitation(purpose = "") {
  return (isHandheld() ? t("Choose or photograph a picture") : t("Drop a picture here")) + purpose;
}

/** Accept files pasted, or dropped anywhere on the page, while the place is shown. */
function receive(place, take) {
  let depth = 0;
  const over = (change) => {
    depth = Math.max(0, depth + change);
    place.classList.toggle("over", depth > 0);
  };
  const heard = {
    dragenter: () => over(1),
    dragleave: () => over(-1),
    drop: (event) => (over(-depth), take(event.dataTransfer.files)),
    paste: (event) => event.clipboardData?.files.length && take(event.clipboardData.files),
  };
  const hear = (event) => {
    if (place.isConnected) heard[event.type](event);
    else for (const kind of Object.keys(heard)) removeEventListener(kind, hear);
  };
  for (const kind of Object.keys(heard)) addEventListener(kind, hear);
}

function pick(props, take) {
  const changed = (event) => {
    take(event.target.files);
    event.target.value = "";
  };
  return h("input", { type: "file", hidden: true, onchange: changed, ...props });
}

/** Phones and tablets have a camera app, and a browser without TLS offers no other camera. */
function hasCamera() {
  return isHandheld() || Boolean(navigator.mediaDevices?.getUserMedia);
}

function isHandheld() {
  return matchMedia("(pointer: coarse)").matches;
}

function isPicture(file) {
  return file.type.startsWith("image/") || /\.(png|jpe?g|webp|tiff?|bmp|gif)$/i.test(file.name);
}
