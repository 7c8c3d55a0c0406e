/** Example pictures for people who have none at hand. */

import { api } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { t } from "../lib/language.js";
import { at } from "../lib/root.js";

const PICTURES = [["portrait.jpg", t("Portrait")], ["camera.jpg", t("Camera")], ["logo.png", t("Logo")], ["characters.png", t("Letters")]];

/** An element that calls onFile(File) with the picture that a person chooses. */
export function gallery(onFile) {
  const one = ([name, words]) => {
    const picture = h("img", { src: at(`/page/new/gallery/${name}`), alt: "", width: 88, height: 88 });
    return h("button", { type: "button", onclick: () => take(picture.src, words + name.slice(name.lastIndexOf(".")), onFile) }, picture, words);
  };
  return h("div", { class: "gallery", role: "group", "aria-label": t("Examples") }, h("p", {}, t("Or try one of these")), PICTURES.map(one));
}

async function take(address, name, onFile) {
  try {
    const blob = await (await api.request("GET", address)).blob();
    onFile(new File([blob], name, { type: blob.type }));
  } catch (error) {
    toast(error.detail ?? error.message, { kind: "bad" });
  }
}
