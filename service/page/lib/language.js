/**
 * The page's words in the reader's language. English stands in the sources, and is the key of the tables in
 * languages/; a table is loaded before anything else, and only if it is needed; the table of the server's sentences
 * with the first sentence that is not on every screen. Sentences without a translation are shown in English
 * (docs/page.md).
 */

import { at } from "./root.js";

/** The name of each language in that language. */
export const LANGUAGES = { en: "English", de: "Deutsch", ja: "日本語" };
const KEPT = "causticmill-language";
const LATE_MS = 1000;
const LOAD_MS = 5000; // then in English: HOLD and STOP do not wait for a translation

/** The language chosen here, or the first of the browser's languages that the page knows. */
export const language = [localStorage.getItem(KEPT), ...navigator.languages.map((one) => one.split("-")[0]), "en"].find((one) =>
  Object.hasOwn(LANGUAGES, one ?? ""),
);
/** The same with the person's country, for dates and times. */
export const locale = navigator.languages.find((one) => one.split("-")[0] === language) ?? language;
const table = language === "en" ? {} : await load("");
let sentences = {}; // of the server
let lacking = false; // a sentence was needed that is in no loaded table
/** @type {Promise<void> | undefined} */
let coming;
document.documentElement.lang = table ? language : "en";

async function load(folder) {
  const answer = await fetch(at(`/page/languages/${folder}${language}.json`), { signal: AbortSignal.timeout(LOAD_MS) }).catch(() => null);
  return answer?.ok ? answer.json().catch(() => null) : null;
}

/** t("Save"), or t`${done} of ${total} lines`, whose key is "{0} of {1} lines"; a text that is in no table stays unchanged. */
export function t(words, ...values) {
  const key = typeof words === "string" ? words : words.reduce((before, part, k) => `${before}{${k - 1}}${part}`);
  const found = table?.[key] ?? key;
  return values.length ? found.replace(/\{(\d)\}/g, (_, k) => values[k]) : found;
}

/** An answer of the server, from JSON, with its sentences in the reader's language. */
export async function readAnswer(text) {
  const answer = JSON.parse(text);
  lacking = false;
  const translated = translate(answer);
  if (!lacking) return translated;
  await loadSentences();
  return translate(answer);
}

/** English after a second: the state of a mill must not wait for a translation. */
function loadSentences() {
  coming ??= load("server/").then((found) => void (sentences = found ?? {}));
  return Promise.race([coming, new Promise((done) => setTimeout(done, LATE_MS))]);
}

/**
 * The same at once, with the tables that are loaded: `phrases`, anywhere in the answer, gives the template and values
 * of each sentence by its text.
 */
export function translate(answer, phrases = {}) {
  if (typeof answer === "string") return Object.hasOwn(phrases, answer) ? say(phrases[answer]) : answer;
  if (!table || language === "en" || typeof answer !== "object" || answer === null) return answer;
  if (Array.isArray(answer)) return answer.map((one) => translate(one, phrases));
  const known = answer.phrases ? { ...phrases, ...answer.phrases } : phrases;
  return Object.fromEntries(Object.entries(answer).map(([name, one]) => [name, name === "phrases" ? one : translate(one, known)]));
}

function say({ template, values }) {
  const words = sentences[template] ?? table?.[template];
  if (words === undefined && /[a-z]/i.test(template)) {
    lacking = true;
    loadSentences(); // a caller that cannot wait gets them next time
  }
  return (words ?? template).replace(/\{(\w+)\}/g, (place, name) => {
    if (!Object.hasOwn(values, name)) return place;
    return typeof values[name] === "string" ? values[name] : say(values[name]);
  });
}

/** From now on, in this browser. */
export function choose(chosen) {
  localStorage.setItem(KEPT, chosen);
  location.reload();
}
