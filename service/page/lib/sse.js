/**
 * Server-sent events over fetch, because EventSource can send no token.
 *
 * A stream that breaks, or says nothing for three heartbeats, is opened again with Last-Event-ID, sooner or later as
 * often as it failed; a restarted server is found again by itself. 204, or a refusal that no waiting mends, is the end.
 */

import { api } from "./api.js";

const SILENCE_MS = 46_000;
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
const HOPELESS = new Set([400, 403, 404, 405, 410, 422]);

/**
 * follow("/v1/jobs/ID/events", {onEvent(name, data, id), onState(state, words)}) -> {close()}
 * state: "open", "away" (words say so; it is tried again), "ended" (words empty where all went well).
 */
export function follow(path, { onEvent, onState = () => {} }) {
  const stop = new AbortController();
  run(path, onEvent, onState, stop.signal);
  return { close: () => stop.abort() };
}

async function run(path, onEvent, onState, stopped) {
  const place = { lastId: "" };
  let fails = 0;
  while (!stopped.aborted) {
    const began = Date.now();
    const end = await once(path, place, onEvent, onState, stopped);
    if (stopped.aborted) return;
    if (end.over) return onState("ended", end.words);
    fails = Date.now() - began > 5000 ? 0 : fails + 1;
    if (end.words) onState("away", end.words);
    await pause(Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** Math.min(fails, 6)), stopped);
  }
}

/** One connection, to its end: {over, words}. */
async function once(path, place, onEvent, onState, stopped) {
  const broken = new AbortController();
  const watch = { timer: 0 };
  const alive = () => {
    clearTimeout(watch.timer);
    watch.timer = setTimeout(() => broken.abort(), SILENCE_MS);
  };
  alive();
  try {
    const headers = { Accept: "text/event-stream", ...(place.lastId && { "Last-Event-ID": place.lastId }) };
    const signal = AbortSignal.any([stopped, broken.signal]);
    const response = await api.request("GET", path, { headers, signal, cache: "no-store", patience_ms: 0 });
    if (response.status === 204) return { over: true, words: "" };
    onState("open", "");
    await read(response.body, place, onEvent, alive);
    return { over: false, words: "" };
  } catch (error) {
    if (HOPELESS.has(error.status) || error.status === 401) return { over: true, words: error.detail };
    return { over: false, words: error.detail || "The connection to the server broke; trying again." };
  } finally {
    clearTimeout(watch.timer);
  }
}

async function read(body, place, onEvent, alive) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    alive();
    const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) deliver(block, place, onEvent);
  }
}

function deliver(block, place, onEvent) {
  const found = { event: "message", data: [] };
  for (const line of block.split("\n")) {
    const [, field, text] = /^([^:]*):? ?(.*)$/s.exec(line);
    if (field === "id") place.lastId = text;
    else if (field === "event") found.event = text;
    else if (field === "data") found.data.push(text);
  }
  if (found.data.length) onEvent(found.event, parsed(found.data.join("\n")), place.lastId);
}

function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return text;
  }
}

/** Waits; a network that comes back, or a page that is looked at again, ends it. */
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
