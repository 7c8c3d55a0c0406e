/** All jobs, newest first, and the place where a new one begins. */

import { api } from "../lib/api.js";
import { h, replace, write } from "../lib/dom.js";
import { count } from "../lib/words.js";
import { dropPlace, invitation } from "../new/drop.js";
import { keep } from "../new/picked.js";
import { jobCard } from "./card.js";
import { thumbnails } from "./thumbnails.js";

const FILTERS = [
  ["all", "All", [], ""],
  ["active", "Working", ["queued", "running"], "No job is being worked on."],
  ["done", "Done", ["succeeded"], "No job is done yet."],
  ["failed", "Failed", ["failed", "cancelled"], "No job failed or was cancelled."],
];
const WHAT = ": you get the programs that mill a clear block, and light through that block paints the picture on a wall.";
const BUSY_MS = 1500;
const CALM_MS = 6000;
const PAGE = 48;

export default async function view(root, params, app) {
  app.title("Jobs");
  const [, , states, none] = FILTERS.find(([key]) => key === params.show) ?? FILTERS[0];
  const list = jobList(states, none);
  const take = (file) => {
    keep(file);
    app.go("#/new");
  };
  const begin = h("section", { "aria-label": "New job" });
  const filter = filterBar(params.show ?? "all");
  const status = h("p", { class: "hidden-words", role: "status" });
  replace(root, h("h1", {}, "Jobs"), begin, filter, list.element, list.empty, list.more, status);

  let compact = null;
  list.onChange = ({ shown, active }) => {
    const nothing = shown === 0 && states.length === 0;
    filter.hidden = nothing;
    write(status, shown === 0 ? "No jobs" : `${count(shown, "job")} shown, ${active} not finished`);
    if (compact === !nothing) return;
    compact = !nothing;
    const words = invitation(nothing ? WHAT : " for a new job");
    replace(begin, dropPlace({ words, onFile: take, compact }));
  };
  await list.start();
  return { leave: list.close };
}

function filterBar(current) {
  const links = FILTERS.map(([key, words]) =>
    h(
      "a",
      {
        class: "button",
        href: key === "all" ? "#/" : `#/?show=${key}`,
        "aria-current": key === current ? "true" : null,
      },
      words,
    ),
  );
  return h("nav", { class: "filters row", "aria-label": "Which jobs", hidden: true }, links);
}

/** What works stands before what waits. */
function inOrder(jobs) {
  return [...jobs.filter(({ state }) => state === "running"), ...jobs.filter(({ state }) => state !== "running")];
}

/** The cards, or `none` in words, and what keeps them true: a light question every now and then, more often while something is going on. */
function jobList(states, none) {
  const query = states.map((state) => `&state=${state}`).join("");
  const pictures = thumbnails();
  const cards = new Map(); // id -> {card, job}
  const stop = new AbortController();
  const made = {
    element: h("ul", { class: "jobs", "aria-label": "Jobs" }),
    empty: h("p", { class: "dim", hidden: true }, none),
    more: h("p", { hidden: true }, h("button", { type: "button", onclick: older }, "Show older jobs")),
    onChange: () => {},
    start,
    close,
  };
  let next = null;
  let timer = 0;
  let paged = false;

  async function start() {
    await refresh();
    document.addEventListener("visibilitychange", whenSeen);
    plan();
  }

  function close() {
    stop.abort();
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", whenSeen);
    pictures.close();
  }

  function plan() {
    clearTimeout(timer);
    if (document.hidden || stop.signal.aborted) return;
    timer = setTimeout(
      () =>
        refresh()
          .catch(() => {})
          .finally(plan),
      active() ? BUSY_MS : CALM_MS,
    );
  }

  function whenSeen() {
    if (!document.hidden)
      refresh()
        .catch(() => {})
        .finally(plan);
  }

  /** The newest page; what is newer than its last job and not on it is gone. */
  async function refresh() {
    const page = await api.get(`/v1/jobs?limit=${PAGE}${query}`, { signal: stop.signal });
    const there = new Set(page.jobs.map((job) => job.id));
    const last = page.jobs.at(-1)?.created_at ?? "";
    for (const [id, { job }] of cards) if (!there.has(id) && (!page.next || job.created_at >= last)) drop(id);
    put(inOrder(page.jobs), { atTop: true });
    if (!paged) next = page.next;
    tell();
  }

  async function older() {
    const page = await api.get(next, { signal: stop.signal });
    paged = true;
    next = page.next;
    put(page.jobs, { atTop: false });
    tell();
  }

  function put(jobs, { atTop }) {
    let before = atTop ? made.element.firstElementChild : null;
    for (const job of jobs) {
      const known = cards.get(job.id);
      const card = known?.card ?? jobCard(job);
      if (known && known.job.etag !== job.etag) card.update(job);
      else if (known) card.update(known.job);
      if (card.element === before) before = before.nextElementSibling;
      else made.element.insertBefore(card.element, before);
      cards.set(job.id, { card, job });
      pictures.show(card.image, job);
    }
  }

  function drop(id) {
    const { card } = cards.get(id);
    pictures.forget(card.image);
    card.element.remove();
    cards.delete(id);
  }

  function tell() {
    made.empty.hidden = cards.size > 0 || states.length === 0;
    made.more.hidden = !next;
    made.onChange({ shown: cards.size, active: active() });
  }

  function active() {
    return [...cards.values()].filter(({ job }) => job.state === "running" || job.state === "queued").length;
  }

  return made;
}
