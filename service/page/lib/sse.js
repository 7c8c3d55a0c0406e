/**
 * Server-sent events over fetch, because EventSource cannot send a token.
 *
 * A stream that breaks, or is silent for three heartbeats, is opened again with Last-Event-ID, after a pause that grows
 * with each failure; so a restarted server is found again. 204, or a refusal that waiting cannot mend, is the end. A
 * hidden page follows nothing; visible pages share one stream.
 */

import { api } from "./api.js";
import { t, translate } from "./language.js";
import { canShare, nameOf, share } from "./shared_stream.js";

const SILENCE_MS = 46_000;
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
const HOPELESS = new Set([400, 403, 404, 405, 410, 422]);

/**
 * follow("/v1/jobs/ID/events", {onEvent(name, data, id), onState(state, words)}) -> {close()}
 * state: "open", "away" (words say so; it is tried again), "ended" (words empty where all went well).
 * @param {string} path @param {{onEvent: (name: string, data: any, id: string) => void, onState?: (state: string, words?: string) => void}} on
 */
export function follow(path, { onEvent, onState = () => {} }) {
  let part = null; // of this page in the stream: {token, place, stop}
  let over = false;
  const receive = (message) => {
    if (message.kind === "event") return onEvent(message.name, message.data, message.id);
    if (message.state === "ended") close();
    onState(message.state, message.words);
  };
  const leave = () => part?.stop.abort();
  const look = () => {
    const other = part?.token !== api.token; // which may not read the same
    if (over || document.hidden || other) leave();
    if (over || document.hidden || (part && !part.stop.signal.aborted)) return;
    const place = part && !other ? part.place : { lastId: "", recent: [] };
    part = { token: api.token, place, stop: new AbortController() };
    takePart(path, receive, part);
  };
  const stopListening = api.onWho(look);
  document.addEventListener("visibilitychange", look);
  function close() {
    over = true;
    leave();
    stopListening();
    document.removeEventListener("visibilitychange", look);
  }
  look();
  return { close };
}

async function takePart(path, receive, { token, place, stop: { signal: stopped } }) {
  const pass = (message) => stopped.aborted || receive(message);
  if (!canShare()) return keep(path, place, pass, () => {}, stopped);
  const name = await nameOf(path, token);
  if (stopped.aborted) return;
  share(name, { place, stopped, onMessage: pass, read: (say, alive, signal) => keep(path, place, say, alive, signal) });
}

/** Keeps the stream open over all its connections, until `stopped` or its end. */
async function keep(path, place, say, alive, stopped) {
  let fails = 0;
  while (!stopped.aborted) {
    const began = Date.now();
    const end = await readOnce(path, place, say, alive, stopped);
    if (stopped.aborted) return;
    if (end.over) return say({ kind: "state", state: "ended", words: end.words });
    fails = Date.now() - began > 5000 ? 0 : fails + 1;
    if (end.words) say({ kind: "state", state: "away", words: end.words });
    await pause(Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** Math.min(fails, 6)), stopped);
  }
}

/** One connection, to its end: {over, words}. */
async function readOnce(path, place, say, alive, stopped) {
  const broken = new AbortController();
  let timer = 0;
  const markAlive = () => {
    clearTimeout(timer);
    timer = setTimeout(() => broken.abort(), SILENCE_MS);
    alive();
  };
  markAlive();
  try {
    const headers = { Accept: "text/event-stream", ...(place.lastId && { "Last-Event-ID": place.lastId }) };
    const signal = AbortSignal.any([stopped, broken.signal]);
    const response = await api.request("GET", path, { headers, signal, cache: "no-store", timeout_ms: 0 });
    if (response.status === 204) return { over: true, words: "" };
    say({ kind: "state", state: "open", words: "" });
    await read(response.body, place, say, markAlive);
    return { over: false, words: "" };
  } catch (error) {
    if (HOPELESS.has(error.status) || error.status === 401) return { over: true, words: error.detail };
    return { over: false, words: error.detail || t("The connection to the server broke; trying again.") };
  } finally {
    clearTimeout(timer);
  }
}

async function read(body, place, say, markAlive) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    markAlive();
    const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) deliver(block, place, say);
  }
}

function deliver(block, place, say) {
  const found = { event: "message", data: [] };
  for (const line of block.split("\n")) {
    const [, field, text] = /^([^:]*):? ?(.*)$/s.exec(line);
    if (field === "id") place.lastId = text;
    else if (field === "event") found.event = text;
    else if (field === "data") found.data.push(text);
  }
  const { event: name, data } = found;
  if (data.length) say({ kind: "event", name, data: parseData(data.join("\n")), id: place.lastId });
}

function parseData(text) {
  try {
    return translate(JSON.parse(text));
  } catch {
    return text;
  }
}

/** Waits; ends early when the network comes back or the page becomes visible again. */
function pause(ms, stopped) {
  return new Promise((done) => {
    const end = () => {
      clearTimeout(timer);
      removeEventListener("online", end);
      stopped.removeEventListener("abort", end);
      done();
    };
    const timer = setTimeout(end, ms);
    addEventListener("online", end);
    stopped.addEventListener("abort", end);
  });
}
