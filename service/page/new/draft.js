/** Keeps an unsent job and the picture for it when a person opens another view or reloads the page. */

const KEY = "draft"; // key of the settings in this tab's own storage
const PICTURES = "pictures"; // of all tabs, by name; a tab's storage has no room for them
const DAY_MS = 86_400_000;

let dropped = null;
let kept = null;
let stored = { file: null, name: "" }; // the picture that was put away last

if (performance.getEntriesByType("navigation")[0]?.type === "navigate") sessionStorage.removeItem(KEY);

/** Keeps a file for the view of a new job. */
export function keep(file) {
  dropped = file;
}

/** The kept file; it can be fetched once. */
export function take() {
  const file = dropped;
  dropped = null;
  return file;
}

/** Keep a person's settings at an address, {picture, edits, name, spec}, while they open another view; null: nothing. */
export function keepDraft(made, address) {
  kept = made;
  if (!made) return sessionStorage.removeItem(KEY);
  const { picture, ...rest } = made;
  sessionStorage.setItem(KEY, JSON.stringify({ ...rest, address, picture: putAway(picture.file) }));
}

/** {picture, edits, name, spec} as it was kept, once; after a reload the picture's `file` instead, and the `address`. */
export async function takeDraft() {
  const [made, text] = [kept, sessionStorage.getItem(KEY)];
  kept = null;
  sessionStorage.removeItem(KEY);
  if (made || !text) return made;
  const { picture, ...rest } = JSON.parse(text);
  const file = await inPictures("readonly", (pictures) => pictures.get(picture)).catch(() => null);
  if (file) stored = { file: file.file, name: picture };
  return file ? { ...rest, file: file.file } : { spec: rest.spec };
}

/** Store a picture so that a reload keeps it, and delete abandoned ones; return its name in the store. */
export function putAway(file) {
  if (stored.file === file) return stored.name;
  const [at, old] = [Date.now(), IDBKeyRange.upperBound(String(Date.now() - DAY_MS))];
  stored = { file, name: `${at}-${Math.random()}` };
  const change = (pictures) => (pictures.delete(old), pictures.put({ file }, stored.name));
  inPictures("readwrite", change).catch(() => null); // no room, or a browser without storage: then a reload loses it
  return stored.name;
}

async function inPictures(mode, ask) {
  const opening = indexedDB.open("causticmill", 1);
  opening.onupgradeneeded = () => opening.result.createObjectStore(PICTURES);
  const database = await answer(opening);
  try {
    return await answer(ask(database.transaction(PICTURES, mode).objectStore(PICTURES)));
  } finally {
    database.close();
  }
}

function answer(request) {
  return new Promise((done, failed) => {
    request.onsuccess = () => done(request.result);
    request.onerror = () => failed(request.error);
  });
}
