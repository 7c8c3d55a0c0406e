/** The shell: chooses the view for an address, and shows the person and the server's presence. */

import { api, ProblemError } from "./lib/api.js";
import { h, replace } from "./lib/dom.js";
import { askForKey, showWho } from "./lib/key.js";
import { watchKeyEnd } from "./lib/key_end.js";
import { choose, language, LANGUAGES, t } from "./lib/language.js";
import { shape } from "./lib/state.js";
import { sentence } from "./lib/words.js";
import { showMill } from "./machine/chip.js";
import { watchForNotifications } from "./machine/notify.js";

/** Address, place in the navigation, how the view is loaded.
 * @type {[RegExp, string, () => Promise<{default: Function}>][]} */
const ROUTES = [
  [/^\/(jobs)?$/, "jobs", () => import("./jobs/list.js")],
  [/^\/new$/, "new", () => import("./new/view.js")],
  [/^\/jobs\/(?<id>[^/]+)$/, "jobs", () => import("./job/view.js")],
  [/^\/compare\/(?<id>[^/]+)\/(?<id2>[^/]+)$/, "jobs", () => import("./job/compare.js")],
  [/^\/machines$/, "machines", () => import("./machine/list.js")],
  [/^\/machines\/(?<name>[^/]+)$/, "machines", () => import("./machine/view.js")],
];

const THEME = "causticmill-colours";
const THEMES = [["", t("as the computer")], ["light", t("light")], ["dark", t("dark")]];

const root = document.getElementById("view");
let current = { leave() {} };
let shows = 0;

/** The shell's interface for a view; a view that loads too late changes nothing. */
function appFor(isCurrent) {
  return {
    /** Words before the name of the program in the title of the window. */
    title(text) {
      if (isCurrent()) document.title = text ? `${text} · causticmill` : "causticmill";
    },
    /** Goes to an address of this page, like "#/jobs/ID". `instead`: Back does not return here. */
    go(hash, { instead = false } = {}) {
      if (instead) location.replace(hash);
      else location.hash = hash;
    },
  };
}

/** Each view has its own place, so that one that loads after the person has left writes out of sight. */
async function show({ focus = true } = {}) {
  shows += 1;
  const mine = shows;
  const isCurrent = () => mine === shows;
  const app = appFor(isCurrent);
  const { path, query } = address();
  const route = ROUTES.map(([pattern, place, load]) => ({ found: pattern.exec(path), place, load })).find((one) => one.found);
  const place = h("div");
  leaveCurrent();
  markPlace(route?.place);
  replace(root, place);
  scrollTo(0, 0);
  app.title("");
  try {
    if (!route) throw new ProblemError(404, t("There is no such page here."));
    const { default: view } = await route.load();
    if (!isCurrent()) return;
    const made = await view(place, { ...decoded(route.found.groups), ...query }, app);
    if (isCurrent()) current = made ?? current;
    else made?.leave?.();
  } catch (error) {
    if (isCurrent()) showFault(error, place, app);
  }
  if (focus && isCurrent()) root.focus({ preventScroll: true });
}

function leaveCurrent() {
  const leaving = current;
  current = { leave() {} };
  leaving.leave?.();
}

function address() {
  const [path, query = ""] = (location.hash.slice(1) || "/").split("?");
  return { path, query: Object.fromEntries(new URLSearchParams(query)) };
}

function decoded(groups = {}) {
  return Object.fromEntries(Object.entries(groups).map(([key, text]) => [key, decodeURIComponent(text)]));
}

/** Only an answer of the server, or none, is certainly not a fault of the page. */
function showFault(error, place, app) {
  const expected = error.name === "ProblemError";
  const none = error.status === 404;
  if (!expected) console.error(error);
  const detail = error.status === 401 ? t("This server asks for its code before it shows this.") : sentence(error.detail ?? "");
  const words = expected ? detail : t`This view cannot be shown (${error.message}). Load the page again.`;
  app.title(t("Not shown"));
  replace(
    place,
    h("h1", {}, t("Not shown")),
    h("p", { class: "notice bad", role: "alert" }, shape("bad"), h("span", {}, words)),
    h(
      "p",
      { class: "row" },
      !none && h("button", { type: "button", class: "primary", onclick: () => (expected ? show() : location.reload()) }, t("Try again")),
      error.status === 401 &&
        h("button", { type: "button", onclick: () => askForKey("jobs:read") }, t("Enter the code")),
      h("a", { class: none ? "button primary" : "button", href: "#/" }, t("All jobs")),
    ),
  );
  const mended = [api.onAway((away) => !away && show()), api.onWho(() => show())];
  current = { leave: () => mended.forEach((stop) => stop()) };
}

function markPlace(place) {
  for (const link of /** @type {NodeListOf<HTMLElement>} */ (document.querySelectorAll(".bar nav a"))) link.ariaCurrent = link.dataset.place === place ? "page" : null;
}

function showAway(away) {
  const words = t("The server does not answer. This page goes on by itself when it is back.");
  replace(document.getElementById("away"), away && h("p", { class: "notice bad" }, shape("bad"), h("span", {}, words)));
  document.body.classList.toggle("away", away);
}

/** The words of index.html, which is the same in every language. */
function translateFrame() {
  for (const one of document.querySelectorAll("[data-t]")) one.textContent = t(one.textContent);
  for (const one of document.querySelectorAll(".bar [aria-label]")) one.ariaLabel = t(one.ariaLabel);
}

function languageChoice() {
  const options = Object.entries(LANGUAGES).map(([value, name]) => h("option", { value, lang: value, selected: value === language }, name));
  return h("label", {}, t("Language"), h("select", { onchange: (event) => choose(event.target.value) }, options));
}

/** Light, dark, or as the computer has it; kept in this browser. */
function themeChoice() {
  const show = (theme) => (document.documentElement.style.colorScheme = theme);
  const options = THEMES.map(([value, name]) => h("option", { value, selected: value === localStorage.getItem(THEME) }, name));
  const take = ({ target: { value } }) => (localStorage.setItem(THEME, value), show(value));
  show(localStorage.getItem(THEME) ?? "");
  return h("label", {}, t("Colours"), h("select", { onchange: take }, options));
}

/** A file dropped beside a drop place must not take the page away. */
function keepDropsHere() {
  for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault());
}

translateFrame();
replace(document.querySelector("footer"), themeChoice(), languageChoice());
api.onAway(showAway);
api.setKeyDialog(askForKey);
showWho(document.getElementById("who"));
showMill(document.getElementById("mill"));
watchForNotifications();
watchKeyEnd(() => askForKey("machine:run"));
keepDropsHere();
addEventListener("hashchange", () => show());
document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault();
  root.focus();
});
api.hello().catch(() => {});
show({ focus: false });
