/**
 * The server's HTTP interface: one place for the token, for refusals, and for whether the server is there at all.
 *
 * The token lives in this module's memory and nowhere else: a reload forgets it. A request without an answer fails with
 * a ProblemError of status 0; from then on the page asks the server from time to time whether it is back, and calls the
 * listeners of `onAway` at both moments.
 */

import { readAnswer, t } from "./language.js";
import { at } from "./root.js";

const TIMEOUT_MS = 20_000;
const AGREE_MS = 5000;
const DECLINED_MS = 60_000;
const PROBE_MS = [500, 1000, 2000, 3000];
const AWAY_STATUS = new Set([502, 504]);
const NOBODY = { name: "", scopes: [], anonymous: true, paired: false, expires_at: null };

/**
 * A refusal: `detail` in words, `code` with `values` where it has one, `effect`: its consequence, `field` and
 * `problems` [{field, detail}]: the values at fault. Status 0: no answer.
 */
export class ProblemError extends Error {
  constructor(status, detail, { code = "", values = {}, effect = "", field = "", problems = [] } = {}) {
    super(detail);
    this.name = "ProblemError";
    this.status = status;
    this.detail = detail;
    this.code = code;
    this.values = values;
    this.effect = effect;
    this.field = field;
    this.problems = problems.length ? problems : field ? [{ field, detail }] : [];
  }
}

let token = "";
let who = NOBODY;
let away = false;
let declined = -Infinity;
/** @type {Promise<any>} */
let settled = Promise.resolve();
let askForKey = async (/** @type {string} */ _) => false;
let clockOff_ms = 0;
const awayListeners = new Set();
const whoListeners = new Set();
const pictures = new Map();

/** @param {string} path @param {string | null} etag */
function isKnown(path, etag) {
  return etag !== null && pictures.get(path)?.etag === etag;
}

function useKnown(path) {
  const known = pictures.get(path);
  known.users += 1;
  return known.url;
}

export const api = {
  get token() {
    return token;
  },
  /** Set a token without a check; `useToken` also checks that the server knows it. */
  set token(secret) {
    token = secret;
    api.hello().catch(() => {});
  },
  get who() {
    return who;
  },
  get away() {
    return away;
  },
  /** The server's time in milliseconds, independent of this computer's clock. */
  now: () => Date.now() + clockOff_ms,

  /** Ask the server for our name and scopes; until then we have none. */
  hello() {
    const asked = askWho();
    settled = asked.catch(() => {});
    return asked;
  },

  async get(path, options = {}) {
    return readJson(await request("GET", path, options));
  },
  async post(path, body, options = {}) {
    const json = body === undefined ? {} : { body: JSON.stringify(body), type: "application/json" };
    return readJson(await request("POST", path, { ...options, ...json }));
  },
  async put(path, body, options = {}) {
    return readJson(await request("PUT", path, { ...options, body: JSON.stringify(body), type: "application/json" }));
  },
  async delete(path, options = {}) {
    return readJson(await request("DELETE", path, options));
  },
  /** Sends a FormData; large pictures over a slow link may take their time. */
  async upload(path, form, options = {}) {
    return readJson(await request("POST", path, { timeout_ms: 0, ...options, body: form }));
  },

  /** An object URL of a file, the same one as long as the file is the same. Give it back with `release(path)`. */
  async blob(path, options = {}) {
    const response = await request("GET", path, { timeout_ms: 0, ...options, cache: "no-cache" });
    const etag = response.headers.get("etag");
    if (isKnown(path, etag)) {
      response.body?.cancel();
      return useKnown(path);
    }
    const content = await response.blob();
    if (isKnown(path, etag)) return useKnown(path); // another asked for it meanwhile
    const known = pictures.get(path), url = URL.createObjectURL(content);
    if (known) URL.revokeObjectURL(known.url);
    pictures.set(path, { etag, url, users: 1 + (known?.users ?? 0) });
    return url;
  },
  /** A picture from `blob(path)` is no longer shown there. */
  release(path) {
    const known = pictures.get(path);
    if (!known) return;
    known.users -= 1;
    if (known.users > 0) return;
    URL.revokeObjectURL(known.url);
    pictures.delete(path);
  },

  /** Bytes `from` up to, without, `to` of a file; all of it without them.
   * @param {string} path @param {{from?: number, to?: number, signal?: AbortSignal}} part */
  async bytes(path, { from = 0, to, signal } = {}) {
    const part = from > 0 || to !== undefined;
    const headers = part ? { Range: `bytes=${from}-${to === undefined ? "" : to - 1}` } : {};
    const response = await request("GET", path, { headers, signal, timeout_ms: 0 });
    const found = await response.arrayBuffer();
    return part && response.status === 200 ? found.slice(from, to) : found;
  },

  /** Whether the caller may do that; if not, the page first asks a person for the key. */
  async need(scope) {
    await settled;
    if (who.scopes.includes(scope)) return true;
    return (await askForKey(scope)) && who.scopes.includes(scope);
  },
  /** How a person is asked for the key: async (scope) -> boolean. The shell sets it. */
  setKeyDialog(ask) {
    askForKey = shareCall(ask);
  },
  /** Exchanges a code that the server printed for a token. */
  async pair(code, name) {
    return api.useToken((await api.post("/v1/pairings", { code, name }, { quiet: true })).token);
  },
  /** Use this token in every request from now on, and return its owner. ProblemError if the server does not know it. */
  async useToken(secret) {
    const before = token;
    token = secret;
    const found = await api.hello();
    if (!found.name) {
      token = before;
      await api.hello();
      throw new ProblemError(401, t("The server does not know this token: it is mistyped, ended or revoked."));
    }
    return found;
  },
  async forget() {
    token = "";
    return api.hello();
  },

  /** fn(true) when the server stops answering, fn(false) when it is back. Returns how to stop listening. */
  onAway: (fn) => listen(awayListeners, fn),
  /** Calls fn(who) whenever the caller changes. */
  onWho: (fn) => listen(whoListeners, fn),
  /** A raw answer, refusals as ProblemError; for streams. */
  request,
};

async function askWho() {
  try {
    const who = await readJson(await request("GET", "/v1/whoami", { quiet: true }));
    setWho(who);
  } catch (error) {
    if (error.status !== 401) throw error;
    setWho(NOBODY);
  }
  return who;
}

function listen(listeners, fn) {
  listeners.add(fn);
  return () => listeners.delete(fn);
}

/** options: headers, body, type, signal, cache, keepalive, timeout_ms (0: none), quiet (a 401 asks nobody for a key).
 * @param {any} options */
async function request(method, path, options = {}) {
  const response = await answer(method, path, options);
  if (response.ok) return response;
  const problem = await problemOf(response);
  if (response.status === 401 && !options.quiet && (await getsKey())) {
    return request(method, path, { ...options, quiet: true });
  }
  throw problem;
}

/** Asks for the key; not again soon after a person has declined, however many views go on asking the server. */
async function getsKey() {
  if (Date.now() - declined < DECLINED_MS) return false;
  const given = await askForKey("jobs:read");
  if (!given) declined = Date.now();
  return given;
}

/** @param {string} method @param {string} path @param {any} options */
async function answer(method, path, { headers = {}, body, type, signal, cache, keepalive, timeout_ms = TIMEOUT_MS }) {
  /** @type {Record<string, string>} */
  const own = { Accept: "application/json", ...headers };
  if (type) own["Content-Type"] = type;
  if (token) own.Authorization = `Bearer ${token}`;
  const signals = [signal, timeout_ms ? AbortSignal.timeout(timeout_ms) : null].filter(Boolean);
  try {
    const response = await fetch(at(path), {
      method,
      headers: own,
      body,
      cache,
      keepalive,
      credentials: "omit",
      signal: signals.length ? AbortSignal.any(signals) : undefined,
    });
    setAway(isOfAnother(response));
    compareClocks(response);
    return response;
  } catch (error) {
    if (signal?.aborted) throw error;
    setAway(true);
    throw new ProblemError(0, t("The server does not answer. Is it running, and is the cable in?"));
  }
}

/** Whether a proxy has answered for a server that is away; the server itself refuses in another form. */
function isOfAnother(response) {
  const ours = response.headers.get("content-type")?.startsWith("application/problem+json");
  return AWAY_STATUS.has(response.status) && !ours;
}

/** Clocks that agree to a few seconds are taken to be the same: answers give whole seconds, and take time. */
function compareClocks(response) {
  const off = Date.parse(response.headers.get("date") ?? "") - Date.now();
  if (Number.isFinite(off)) clockOff_ms = Math.abs(off) < AGREE_MS ? 0 : off;
}

async function problemOf(response) {
  let body = {};
  try {
    body = await readAnswer(await response.text());
  } catch {
    // a proxy's page, or nothing: the status must do
  }
  const detail = body.detail ?? t`The server answered ${response.status}; its log says why.`;
  return new ProblemError(response.status, detail, body);
}

async function readJson(response) {
  if (response.status === 204) return null;
  const text = await response.text();
  return text ? readAnswer(text) : null;
}

function setWho(found) {
  who = found;
  for (const listener of [...whoListeners]) listener(found); // not listeners that are added meanwhile: there may be no end of them
}

function setAway(now) {
  if (now === away) return;
  away = now;
  for (const listener of [...awayListeners]) listener(now);
  if (now) probe(0);
}

/** Asks the server's root, which is open to everybody, until it answers. */
async function probe(tries) {
  await new Promise((done) => setTimeout(done, PROBE_MS[Math.min(tries, PROBE_MS.length - 1)]));
  if (!away) return;
  try {
    const response = await fetch(at("/"), {
      headers: { Accept: "application/json" },
      cache: "no-store",
      signal: AbortSignal.timeout(4000),
    });
    if (!isOfAnother(response)) return setAway(false);
  } catch {
    // still away
  }
  probe(tries + 1);
}

/** While one call is under way, others get its promise. */
function shareCall(ask) {
  let running = null;
  return (...given) => {
    running ??= ask(...given).finally(() => {
      running = null;
    });
    return running;
  };
}
