/** The code that the server printed where it runs, exchanged for a token that this page's memory holds. */

import { api } from "./api.js";
import { confirm, open } from "./dialog.js";
import { freshId, h, replace } from "./dom.js";
import { t } from "./language.js";
import { sentence } from "./words.js";

const CODE = /^[0-9A-Z]{12}$/;
const WHAT = {
  "machine:run": t("Enter the code to run a mill"),
  "jobs:write": t("Enter the code to make or change jobs"),
  "jobs:read": t("Enter the code"),
};

/** Asks for the code; resolves to whether the server knows the given one. */
export async function askForKey(scope) {
  return (await open({ title: WHAT[scope] ?? WHAT["jobs:read"], body: form })) === true;
}

function form(close) {
  const [hint, fault] = [freshId("hint"), freshId("fault")];
  const key = h("input", {
    id: freshId("code"),
    type: "text",
    required: true,
    autocomplete: "off",
    autocapitalize: "characters",
    spellcheck: false,
    placeholder: "XXXX-XXXX-XXXX",
    "aria-describedby": `${hint} ${fault}`,
    oninput: () => key.selectionStart === key.value.length && (key.value = spelled(key.value)), // not in the middle of the code
  });
  const name = h("input", {
    type: "text",
    required: true,
    maxLength: 40,
    autocomplete: "name",
    value: api.who.anonymous ? usualName() : api.who.name,
  });
  const wrong = h("p", { class: "fault", id: fault, role: "alert" });
  const submit = h("button", { type: "submit", class: "primary" }, t("Enter"));
  const send = async (event) => {
    event.preventDefault();
    submit.disabled = true;
    try {
      await exchange(key.value, name.value.trim());
      close(true);
    } catch (error) {
      replace(wrong, sentence(error.detail ?? error.message));
      key.focus();
    } finally {
      submit.disabled = false;
    }
  };
  return h(
    "form",
    { class: "stack", onsubmit: send },
    h(
      "div",
      { class: "field" },
      h("label", { for: key.id }, t("Code")),
      key,
      h("small", { id: hint }, t("Twelve letters and digits, printed where the server runs.")),
      wrong,
    ),
    h(
      "details",
      {},
      h("summary", {}, t("No code at hand?")),
      h("p", {}, t("On the server's computer, this prints a new one (DIR is the server's folder):")),
      h("p", {}, h("code", {}, "causticmill token pair --data DIR")),
      h("p", {}, t("A token may be pasted in place of a code, too.")),
    ),
    h("label", { class: "field" }, h("span", {}, t("Your name, as others see it")), name),
    h("div", { class: "actions" }, h("button", { type: "button", onclick: () => close(false) }, t("Cancel")), submit),
  );
}

/** The name that others see if the user gives none. */
function usualName() {
  return matchMedia("(pointer: coarse)").matches ? t("Phone") : t("Computer");
}

/** Formats a code like the printed one while it is typed; a token stays unchanged. */
function spelled(text) {
  const code = bare(text);
  if (text.startsWith("cm_") || !/^[0-9A-Z]{5,12}$/.test(code)) return text;
  return code.match(/.{1,4}/g).join("-");
}

function bare(text) {
  return text.replace(/[\s-]/g, "").toUpperCase();
}

async function exchange(text, name) {
  const code = bare(text);
  if (CODE.test(code)) return api.pair(code, name);
  if (text.trim().startsWith("cm_")) return api.useToken(text.trim());
  throw new Error(t("A code is twelve letters and digits, like XXXX-XXXX-XXXX."));
}

/** An accidental touch of one's own name must not give up control of the mill. */
async function giveBack() {
  const sure = await confirm({
    title: t("Forget the code here?"),
    words: t("This page cannot run a mill then, until the code is entered again."),
    yes: t("Forget it"),
    no: t("Keep it"),
  });
  if (sure) api.forget();
}

/** Keeps a button up to date that says who is here, and takes a code or forgets it. */
export function showWho(button) {
  const show = (who) => {
    const known = api.token !== "" && who.name;
    button.textContent = known ? who.name : t("Enter code");
    button.title = known ? t("Forget the code on this page") : t("To run a mill from this page");
  };
  button.addEventListener("click", () => (api.token ? giveBack() : api.need("machine:run")));
  api.onWho(show);
  show(api.who);
}
