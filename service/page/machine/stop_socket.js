/**
 * A separate channel for HOLD, STOP and the end of a jog: a WebSocket, which takes none of the few connections that a
 * browser keeps to one server, and is open before it is needed. It opens again by itself.
 */

import { api, ProblemError } from "../lib/api.js";
import { translate } from "../lib/language.js";
import { at } from "../lib/root.js";

const SILENCE_MS = 13_000; // the server sends something every 5 s
const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 8000;
const NOT_FOR_US = 4401;

export class StopSocket {
  constructor() {
    this.socket = null;
    this.ready = false;
    this.number = 0;
    this.waiting = new Map(); // number of a stop -> {resolve, reject}
    this.token = null; // token that the server has seen
    this.fails = 0;
    this.timer = 0;
    this.stopListening = api.onWho(() => api.token !== this.token && this.open());
    this.again = () => !this.socket && this.open();
    addEventListener("online", this.again);
    this.open();
  }

  close() {
    this.closed = true;
    this.stopListening();
    removeEventListener("online", this.again);
    this.drop("The page of this mill was left.");
  }

  /** The server's answer to this stop; an Error if the socket is not open or the stop was not accepted. */
  send(machine, what) {
    if (!this.ready) return Promise.reject(new Error("The way for stops is not open."));
    this.number += 1;
    const id = this.number;
    return new Promise((resolve, reject) => {
      this.waiting.set(id, { resolve, reject });
      this.socket.send(JSON.stringify({ id, machine, what }));
    });
  }

  open() {
    if (this.closed) return;
    this.drop("The way for stops is opened anew.");
    this.token = api.token;
    try {
      this.socket = new WebSocket(location.origin.replace(/^http/, "ws") + at("/v1/stops"));
    } catch {
      return; // a browser that forbids it: stops go by the other way
    }
    const { socket } = this;
    socket.onopen = () => socket.send(JSON.stringify({ token: this.token }));
    socket.onmessage = ({ data }) => socket === this.socket && this.hear(translate(JSON.parse(data)));
    socket.onclose = ({ code }) => socket === this.socket && this.lose(code);
    this.watch();
  }

  hear(message) {
    this.watch();
    if (message.ready) {
      this.ready = true;
      this.fails = 0;
    }
    const stop = this.waiting.get(message.id);
    if (!stop) return;
    this.waiting.delete(message.id);
    if (message.taken) stop.resolve(message);
    else stop.reject(new ProblemError(0, message.detail, message));
  }

  /** A broken connection may go unnoticed for minutes. */
  watch() {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.lose(0), SILENCE_MS);
  }

  lose(code) {
    this.drop("The way for stops broke.");
    if (this.closed || code === NOT_FOR_US) return; // until this page has another token
    this.timer = setTimeout(this.again, Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** this.fails));
    this.fails += 1;
  }

  drop(words) {
    clearTimeout(this.timer);
    this.socket?.close();
    this.socket = null;
    this.ready = false;
    for (const { reject } of this.waiting.values()) reject(new Error(words));
    this.waiting.clear();
  }
}
