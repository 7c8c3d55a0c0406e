/** A photograph by this computer's camera: shows its picture until a person takes it. */

import { open, toast } from "../lib/dialog.js";
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";

const WANTED = { video: { facingMode: "environment", width: { ideal: 1920 }, height: { ideal: 1440 } } };
const REFUSED = {
  NotAllowedError: t("This page may not use the camera. Allow it beside the address, or choose a file."),
  NotFoundError: t("No camera is connected here. Choose a file."),
  NotReadableError: t("The camera is in use by another program."),
};

/** The photograph as a File; null if none was taken, after a message with the reason. */
export async function photograph() {
  let stream = null;
  try {
    stream = await navigator.mediaDevices.getUserMedia(WANTED);
  } catch (error) {
    toast(REFUSED[error.name] ?? t`The camera cannot be used. ${error.message}`, { kind: "bad" });
    return null;
  }
  try {
    return await open({ title: t("Take a photo"), body: (close) => finder(stream, close), wide: true });
  } finally {
    for (const track of stream.getTracks()) track.stop();
  }
}

function finder(stream, close) {
  const shutter = h("button", { type: "button", class: "primary", disabled: true, onclick: () => take() }, t("Take it"));
  const video = h("video", {
    style: { "max-width": "100%", "max-height": "60vh" },
    srcObject: stream,
    muted: true,
    autoplay: true,
    playsInline: true,
    "aria-label": t("What the camera sees"),
    onloadeddata: () => (shutter.disabled = false),
  });
  async function take() {
    const canvas = new OffscreenCanvas(video.videoWidth, video.videoHeight);
    canvas.getContext("2d").drawImage(video, 0, 0);
    const name = `photo ${new Date().toISOString().slice(0, 16).replace("T", " ").replace(":", ".")}.png`;
    close(new File([await canvas.convertToBlob({ type: "image/png" })], name, { type: "image/png" }));
  }
  const cancel = h("button", { type: "button", onclick: () => close(null) }, t("Cancel"));
  return [video, h("div", { class: "actions" }, cancel, shutter)];
}
