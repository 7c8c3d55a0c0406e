/**
 * Files for a person to keep. Where no token is needed a plain link is best: the browser saves as it loads. A token
 * cannot be put into a link, so then the file is fetched, straight onto the disk where the browser can do that
 * (showSaveFilePicker), otherwise through memory.
 */
import { api } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { toast } from "../lib/dialog.js";
import { language, t } from "../lib/language.js";
import { at } from "../lib/root.js";
import { bytes, percent } from "../lib/words.js";

/** A link that saves `url` under `name`; it looks like a button unless `plain`. fetched: by this page, which can show why it fails.
 * @param {{url: string, name: string, size?: number, words: any, plain?: boolean, fetched?: boolean}} options */
export function saveLink({ url, name, size, words, plain = false, fetched = false }) {
  const link = h("a", { class: plain ? "" : "button", href: at(url), download: name }, words ?? name);
  link.addEventListener("click", (event) => {
    if (!api.token && !fetched) return;
    event.preventDefault();
    if (link.dataset.busy) return;
    link.dataset.busy = "yes";
    fetchAndSave({ url: link.getAttribute("href"), name: link.download, size, link }).finally(() => delete link.dataset.busy);
  });
  return link;
}

/** The setup sheet among a job's files, in the language of the page where it was written in it. */
export function sheetOf(artifacts) {
  return artifacts.get(`report-${language}.html`) ?? artifacts.get("report.html");
}

/** The setup sheet: opens beside this page; where that needs a token, it is saved with its pictures in it. */
export function sheetLink(file, words) {
  const link = h("a", { href: at(file.url), target: "_blank", rel: "noopener" }, words);
  link.addEventListener("click", (event) => {
    if (!api.token) return;
    event.preventDefault();
    wholeSheet(file.url).then(
      (text) => saveBlob(new Blob([text], { type: "text/html" }), file.name),
      (error) => toast(t`${file.name} was not saved. ${error.detail ?? error.message}`, { kind: "bad" }),
    );
  });
  return link;
}

async function wholeSheet(url) {
  const folder = url.slice(0, url.lastIndexOf("/") + 1), text = await (await api.request("GET", url)).text();
  const page = new DOMParser().parseFromString(text, "text/html");
  for (const picture of page.querySelectorAll("img[src]")) {
    const response = await api.request("GET", folder + picture.getAttribute("src"));
    picture.setAttribute("src", await asData(await response.blob()));
  }
  return `<!doctype html>\n${page.documentElement.outerHTML}`;
}

function asData(blob) {
  return new Promise((done, fail) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.onerror = () => fail(reader.error);
    reader.readAsDataURL(blob);
  });
}

async function fetchAndSave({ url, name, size, link }) {
  const usual = link.textContent;
  try {
    const target = await pickTarget(name);
    const response = await api.request("GET", url, { timeout_ms: 0 });
    const total = Number(response.headers.get("content-length")) || size;
    const showShare = (done) => (link.textContent = `${name}: ${total ? percent(done / total) : bytes(done)}`);
    const counted = response.body.pipeThrough(counter(showShare));
    if (target) await counted.pipeTo(target);
    else await saveBlob(await new Response(counted).blob(), name);
  } catch (error) {
    if (error.name !== "AbortError") toast(t`${name} was not saved. ${error.detail ?? error.message}`, { kind: "bad" });
  } finally {
    link.textContent = usual;
  }
}

/** A stream onto the disk; null if the browser has none. AbortError if the person cancels. */
async function pickTarget(name) {
  if (!window.showSaveFilePicker) return null;
  return (await window.showSaveFilePicker({ suggestedName: name })).createWritable();
}

function counter(onCount) {
  let done = 0;
  return new TransformStream({
    transform(piece, out) {
      done += piece.byteLength;
      onCount(done);
      out.enqueue(piece);
    },
  });
}

export async function saveBlob(blob, name) {
  const url = URL.createObjectURL(blob);
  h("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}
