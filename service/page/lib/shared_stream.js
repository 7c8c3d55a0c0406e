/**
 * One event stream for all tabs of a browser, which keeps only six connections to one server.
 *
 * The tab that holds the lock (Web Locks API) leads: it reads the stream and tells the others over a BroadcastChannel.
 * When it closes, the browser gives the lock to the next one, which continues after the last event that it received. A
 * leader that is silent for longer than a stream may be loses its lock. Only tabs with the same token share, because
 * another token may not give access to the same data: the name of the channel is a digest of it. Where the browser has
 * no locks or no digests (a page without TLS from another computer), every tab reads its own.
 */

const SILENCE_MS = 60_000; // longer than a leader waits for its server
const MOST = 400; // events sent to a tab that opens later
const NEWEST_ONLY = new Set(["status", "progress"]); // each contains everything of the one before

/** Whether this browser lets tabs share: only if the page came over a private connection. */
export function canShare() {
  return Boolean(globalThis.navigator?.locks && globalThis.BroadcastChannel && globalThis.crypto?.subtle);
}

/** The name under which tabs with this token share the stream of this path; it does not reveal the token. */
export async function nameOf(path, token) {
  const bytes = await crypto.subtle.digest("SHA-256", new TextEncoder().encode(`stream ${token} ${path}`));
  return `stream-${[...new Uint8Array(bytes)].map((byte) => byte.toString(16).padStart(2, "0")).join("")}`;
}

/**
 * Takes part in the stream of this name until `stopped` (a signal) or its end.
 *
 * place: {lastId, recent}, kept up to date. read(say, alive, signal): reads the stream itself, over all its connections,
 * until the signal or its end, and says {kind: "event", name, data, id} and {kind: "state", state, words}.
 * onMessage(message): called in this tab for each message, whichever tab leads.
 */
export function share(name, { place, stopped, read, onMessage }) {
  const me = crypto.randomUUID();
  const channel = new BroadcastChannel(name);
  const over = new AbortController();
  const ended = AbortSignal.any([stopped, over.signal]);
  let leading = null; // AbortController while it is this tab that reads
  let state = null;
  let timer = 0;

  const say = (message) => ended.aborted || channel.postMessage(message);
  const join = () => say({ kind: "join", from: me, lastId: place.lastId });

  function take(message) {
    if (message.kind === "state") state = message;
    else if (message.kind === "event") remember(place, message);
    else return;
    onMessage(message);
    if (message.state === "ended") over.abort();
  }

  /** The events that a later tab has missed; all of them if it has none. */
  function tellLate({ from, lastId }) {
    const known = lastId ? place.recent.findLastIndex((one) => one.id === lastId) : -1;
    const missed = place.recent.filter((one, k) => k > known || NEWEST_ONLY.has(one.name));
    for (const message of [state, ...missed]) if (message) say({ ...message, to: from });
  }

  channel.onmessage = ({ data: message }) => {
    if (ended.aborted) return;
    if (leading) return void (message.kind === "join" && tellLate(message));
    watch();
    if (message.kind === "lead") join();
    else if (!message.to || message.to === me) take(message);
  };

  async function lead() {
    const own = (leading = new AbortController());
    clearTimeout(timer);
    say({ kind: "lead" });
    const both = (message) => {
      say(message);
      take(message);
    };
    await read(both, () => say({ kind: "alive" }), AbortSignal.any([ended, own.signal]));
  }

  /** Wait for the lock until it is ours; wait again if another tab has taken it away. */
  async function queue(how) {
    try {
      await navigator.locks.request(name, how, lead);
    } catch {
      leading?.abort();
      leading = null;
      if (ended.aborted) return;
      watch();
      queue({ signal: ended });
    }
  }

  /** A listening tab takes the lock if the tab that has it is silent. */
  function watch() {
    clearTimeout(timer);
    timer = setTimeout(() => queue({ steal: true }), SILENCE_MS);
  }

  ended.addEventListener("abort", () => {
    clearTimeout(timer);
    channel.close();
  });
  join();
  watch();
  queue({ signal: ended });
}

function remember(place, message) {
  if (message.id) place.lastId = message.id;
  if (NEWEST_ONLY.has(message.name)) place.recent = place.recent.filter((one) => one.name !== message.name);
  place.recent.push(message);
  if (place.recent.length > MOST) place.recent.shift();
}
