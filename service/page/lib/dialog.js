/** Questions that wait for an answer, and messages that disappear by themselves. */

import { freshId, h } from "./dom.js";
import { t } from "./language.js";

const TOAST_MS = 6000;

/**
 * A dialog; resolves with the value passed to `close(value)`, null if it was dismissed (Escape). It takes all other
 * controls away, but never from a screen that stops a mill.
 * body: nodes, or (close) => nodes. actions: [{words, value, kind: "primary"|"danger"|""}], in the order shown.
 */
export function open({ title, body, actions = [], wide = false }) {
  return new Promise((answered) => {
    const id = freshId("dialog");
    const close = (value) => {
      answered(value);
      dialog.close();
    };
    const dismiss = (event) => event.key === "Escape" && close(null);
    const dialog = h(
      "dialog",
      {
        class: wide ? "wide" : "",
        "aria-labelledby": id,
        onclose: () => (answered(null), dialog.remove()),
        onkeydown: dismiss,
      },
      h("h2", { id }, title),
      typeof body === "function" ? body(close) : body,
      actions.length > 0 && h("div", { class: "actions" }, actions.map((action) => button(action, close))),
    );
    document.body.append(dialog);
    if (document.querySelector(".stops")) dialog.show();
    else if (document.querySelector("#mill:not([hidden])")) showBeside(dialog);
    else dialog.showModal();
  });
}

/** Like a modal dialog, except that the mill in the head of the page can still be held. */
function showBeside(dialog) {
  /** @type {NodeListOf<HTMLElement>} */
  const rest = document.querySelectorAll(".skip, .bar > :not(#mill), #view");
  for (const part of rest) part.inert = true;
  dialog.addEventListener("close", () => rest.forEach((part) => (part.inert = false)));
  dialog.show();
}

function button({ words, value, kind = "" }, close) {
  return h("button", { type: "button", class: kind, onclick: () => close(value) }, words);
}

/** Asks before something that cannot be undone, or that moves a mill; the harmless answer has the focus. */
export async function confirm({ title, words, yes, no = t("Cancel"), danger = false }) {
  const paragraphs = [words].flat().map((text) => (typeof text === "string" ? h("p", {}, text) : text));
  const actions = [
    { words: no, value: false },
    { words: yes, value: true, kind: danger ? "danger" : "primary" },
  ];
  return (await open({ title, body: paragraphs, actions })) === true;
}

/**
 * A sentence at the edge of the page, read out by screen readers. kind: "", "good", "bad"; stays: until it is closed.
 * Returns {close()}.
 * @param {any} words @param {{kind?: string, action?: {words: string, run: () => void}, stays?: boolean}} options
 */
export function toast(words, { kind = "", action, stays = false } = {}) {
  const shown = h(
    "div",
    { class: `toast ${kind}` },
    h("span", {}, words),
    action && h("button", { type: "button", onclick: () => (shown.remove(), action.run()) }, action.words),
    h("button", { type: "button", class: "quiet", "aria-label": t("Close"), onclick: () => shown.remove() }, "×"),
  );
  shelf().append(shown);
  const leave = () => setTimeout(() => (shown.matches(":hover, :focus-within") ? leave() : shown.remove()), TOAST_MS);
  if (!stays) leave();
  return { close: () => shown.remove() };
}

function shelf() {
  return document.getElementById("toasts");
}
