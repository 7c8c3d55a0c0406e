/** A photograph from a phone's camera or a file, sent to the server and shown with the findings. */
import { api } from "./api.js";
import { h, replace, write } from "./dom.js";
import { t } from "./language.js";
import { sentence } from "./words.js";

const BUSY = t("Looking at the photograph…");

/**
 * {button, node, clear()}: node holds the answer. address(): where it is sent; lines(answer): texts or elements of a
 * list; alt(): of the picture that comes with them.
 */
export function photograph({ words = t("Take or choose a photograph"), address, lines, alt }) {
  const message = h("p", { class: "photo-said", "aria-live": "polite" });
  const found = h("ul", { class: "photo-findings" });
  const picture = h("img", { class: "photo-picture", alt: "", hidden: true });
  const input = h("input", { type: "file", accept: "image/*", capture: "environment", hidden: true, onchange: lookAtChosen });
  let asked = 0; // the answer to an earlier request is no longer shown
  const button = h("button", { type: "button", onclick: () => input.click() }, words);

  function lookAtChosen() {
    const [file] = input.files;
    input.value = ""; // the same file may be chosen again
    if (file) look(file);
  }
  async function look(file) {
    const form = new FormData();
    form.append("photo", file);
    clear();
    const mine = asked;
    button.disabled = true;
    show(BUSY);
    try {
      if (!(await api.need("jobs:write"))) return clear();
      const answer = await api.upload(address(), form, { quiet: true });
      if (mine === asked) show("", lines(answer), `data:image/png;base64,${answer.picture}`);
    } catch (error) {
      if (mine === asked) show(sentence(error.detail ?? error.message));
    } finally {
      if (mine === asked) button.disabled = false;
    }
  }
  function clear() {
    asked += 1;
    button.disabled = false;
    show("");
  }
  function show(words, findings = [], source = "") {
    write(message, words);
    message.hidden = !words;
    replace(found, findings.map((one) => h("li", {}, one)));
    found.hidden = findings.length === 0;
    picture.hidden = !source;
    picture.alt = source ? alt() : "";
    if (source) picture.src = source;
    else picture.removeAttribute("src");
  }
  clear();
  return { button: [button, input], node: [message, found, picture], clear };
}
