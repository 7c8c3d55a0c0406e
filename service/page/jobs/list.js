/** All jobs, running and new ones first, or the results of a search; and the place to start a new job. */

import { api } from "../lib/api.js";
import { confirm } from "../lib/dialog.js";
import { h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isGoing } from "../lib/state.js";
import { jobName, sentence } from "../lib/words.js";
import { darkRoom, dropPlace, invitation } from "../new/drop.js";
import { keep } from "../new/draft.js";
import { isFound, jobCard } from "./card.js";

const FILTERS = [
  ["all", t("All"), [], ""],
  ["active", t("Working"), ["queued", "running"], t("No job is being worked on.")],
  ["done", t("Done"), ["succeeded"], t("No job is done yet.")],
  ["failed", t("Failed"), ["failed", "cancelled"], t("No job failed or was cancelled.")],
];
const NEWEST = (a, b) => (a.created_at < b.created_at ? 1 : -1);
const WORKS = (a, b) => Number(b.state === "running") - Number(a.state === "running");
const SORTS = {
  "": [t("Newest first"), (a, b) => WORKS(a, b) || NEWEST(a, b)],
  old: [t("Oldest first"), (a, b) => NEWEST(b, a)],
  name: [t("By name"), (a, b) => jobName(a).localeCompare(jobName(b), [], { numeric: true, sensitivity: "base" })],
};
const BUSY_MS = 1500;
const CALM_MS = 6000;
const PAGE = 48;
const WHOLE_PAGE = 200; // where all are wanted
const MOST = 2000;

export default async function view(root, params, app) {
  app.title(t("Jobs"));
  const [, , states, none] = FILTERS.find(([key]) => key === params.show) ?? FILTERS[0];
  const asked = { show: params.show ?? "all", q: params.q ?? "", sort: params.sort in SORTS ? params.sort : "" };
  const list = jobList(states, none, asked);
  const take = (file) => {
    keep(file);
    app.go("#/new");
  };
  const begin = h("section", { "aria-label": t("New job") });
  const tools = toolbar(asked, list);
  const status = h("p", { class: "hidden-words", role: "status" });
  const title = h("h1", {}, t("Jobs"));
  replace(root, title, begin, tools.node, list.element, list.empty, list.more, status);

  let compact = null;
  list.onChange = ({ known, shown, active }) => {
    const nothing = known === 0 && states.length === 0;
    tools.update(nothing);
    write(status, shown === 0 ? t("No jobs") : shown === 1 ? t`${shown} job shown, ${active} not finished` : t`${shown} jobs shown, ${active} not finished`);
    if (compact === !nothing) return;
    compact = !nothing;
    title.className = nothing ? "hidden-words" : "";
    replace(begin, nothing ? darkRoom(take, "focus") : dropPlace({ words: invitation(t(" for a new job")), onFile: take, compact }));
  };
  await list.start();
  return { leave: list.close };
}

function addressOf(asked) {
  const query = Object.entries(asked).filter(([key, value]) => value && !(key === "show" && value === "all"));
  return query.length ? `#/?${new URLSearchParams(query)}` : "#/";
}

/** The search and order of the list, and the selection of many jobs for deletion. The search stays in the address. */
function toolbar(asked, list) {
  const links = FILTERS.map(([key, words]) => h("a", { class: "button", "aria-current": key === asked.show ? "true" : null }, words));
  const search = h("input", { type: "search", value: asked.q, placeholder: t("Search"), "aria-label": t("Search by name, mill, state or number"), oninput: () => change({ q: search.value.trim() }) });
  const options = Object.entries(SORTS).map(([value, [words]]) => h("option", { value, selected: value === asked.sort }, words));
  const sort = h("select", { "aria-label": t("Order"), onchange: () => change({ sort: sort.value }) }, options);
  const pick = h("button", { type: "button", "aria-pressed": "false", onclick: () => setPicking(!list.picking) }, t("Select"));
  const all = h("button", { type: "button", onclick: () => list.pickAll() }, t("All shown"));
  const remove = h("button", { type: "button", class: "danger", onclick: () => deletePicked() });
  const said = h("p", { class: "fault", role: "status" });
  const many = h("div", { class: "row", hidden: true }, all, remove);
  const filters = h("nav", { class: "filters row", "aria-label": t("Which jobs"), hidden: true }, links);
  const node = h("div", { class: "job-tools", hidden: true }, filters, h("div", { class: "row find" }, search, sort, pick), many, said);

  function change(more) {
    Object.assign(asked, more);
    history.replaceState(null, "", addressOf(asked));
    setLinks();
    list.ask();
  }
  function setLinks() {
    links.forEach((link, k) => (link.href = addressOf({ ...asked, show: FILTERS[k][0] })));
  }
  function setPicking(on) {
    list.setPicking(on);
    pick.setAttribute("aria-pressed", String(on));
    write(said, "");
  }
  async function deletePicked() {
    const found = list.picked();
    const sure = await confirm({ title: found.length === 1 ? t`Delete ${found.length} job?` : t`Delete ${found.length} jobs?`, words: t("Their pictures and programs go, too."), yes: t("Delete"), danger: true });
    if (!sure || !(await api.need("jobs:write"))) return;
    write(said, (await list.delete(found)).join(" "));
    if (!said.textContent) setPicking(false);
  }
  setLinks();
  return {
    node,
    update(nothing) {
      node.hidden = filters.hidden = nothing;
      const { length } = list.picked();
      many.hidden = !list.picking;
      write(remove, length ? t`Delete ${length}` : t("Delete"));
      remove.disabled = length === 0;
    },
  };
}

/** The cards, or the text `none`; a small request at intervals, shorter while a job runs, keeps them current. */
function jobList(states, none, asked) {
  const query = states.map((state) => `&state=${state}`).join("");
  const cards = new Map(); // id -> {card, job}
  const stop = new AbortController();
  const made = {
    element: h("ul", { class: "jobs", "aria-label": t("Jobs"), onchange: () => announce() }),
    empty: h("p", { class: "dim", hidden: true }),
    more: h("p", { hidden: true }, h("button", { type: "button", onclick: () => loadOlder(PAGE).then(announce) }, t("Show older jobs"))),
    picking: false,
    onChange: (/** @type {object} */ _) => {},
    start,
    close,
    ask,
    setPicking,
    pickAll,
    picked: () => [...cards.values()].filter(({ card }) => made.picking && card.pick.checked && !card.element.hidden).map(({ job }) => job),
    delete: deleteAll,
  };
  let next = null;
  let timer = 0;
  let paged = false;

  async function start() {
    await refresh();
    if (asked.q || asked.sort) await ask();
    document.addEventListener("visibilitychange", whenSeen);
    plan();
  }

  function close() {
    stop.abort();
    clearTimeout(timer);
    document.removeEventListener("visibilitychange", whenSeen);
    for (const { card } of cards.values()) card.free();
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

  /** Load the newest page; jobs newer than its last one that are not on it have been deleted. */
  async function refresh() {
    const page = await api.get(`/v1/jobs?limit=${PAGE}${query}`, { signal: stop.signal });
    const there = new Set(page.jobs.map((job) => job.id));
    const last = page.jobs.at(-1)?.created_at ?? "";
    for (const [id, { job }] of cards) if (!there.has(id) && (!page.next || job.created_at >= last)) drop(id);
    page.jobs.forEach(put);
    if (!paged) next = page.next;
    announce();
  }

  async function loadOlder(limit) {
    const page = await api.get(next.replace(/limit=\d+/, `limit=${limit}`), { signal: stop.signal });
    paged = true;
    next = page.next;
    page.jobs.forEach(put);
  }

  /** A search or another order covers all jobs: fetch those that were not needed so far. */
  async function ask() {
    announce();
    while (next && (asked.q || asked.sort) && cards.size < MOST) await loadOlder(WHOLE_PAGE);
    announce();
  }

  function put(job) {
    const known = cards.get(job.id);
    const card = known?.card ?? jobCard(job);
    if (known) card.update(job);
    cards.set(job.id, { card, job });
  }

  function drop(id) {
    const { card } = cards.get(id);
    card.free();
    card.element.remove();
    cards.delete(id);
  }

  /** Move only the cards whose place has changed: the others keep the focus. */
  function arrange() {
    const wanted = asked.q.toLowerCase().split(/\s+/);
    const rows = [...cards.values()].sort((a, b) => SORTS[asked.sort][1](a.job, b.job));
    let before = made.element.firstElementChild;
    for (const { card, job } of rows) {
      card.element.hidden = !isFound(job, wanted);
      if (card.element === before) before = before.nextElementSibling;
      else made.element.insertBefore(card.element, before);
    }
    return rows.filter(({ card }) => !card.element.hidden).length;
  }

  function setPicking(on) {
    made.picking = on;
    made.element.classList.toggle("picking", on);
    if (!on) for (const { card } of cards.values()) card.pick.checked = false;
    announce();
  }

  function pickAll() {
    const shown = [...cards.values()].map(({ card }) => card).filter(({ element }) => !element.hidden);
    const all = shown.every(({ pick }) => pick.checked);
    for (const { pick } of shown) pick.checked = !all;
    announce();
  }

  /** Delete the jobs one after the other; return why some were not deleted, in sentences. */
  async function deleteAll(jobs) {
    const refusals = [];
    for (const job of jobs) {
      try {
        await api.delete(`/v1/jobs/${job.id}`);
        drop(job.id);
      } catch (error) {
        refusals.push(`${jobName(job)}: ${sentence(error.detail ?? error.message)}`);
      }
      announce();
    }
    return refusals;
  }

  function announce() {
    const shown = arrange();
    made.empty.hidden = shown > 0 || (states.length === 0 && !asked.q);
    write(made.empty, asked.q ? t("No job has all of these words.") : none);
    made.more.hidden = !next;
    made.onChange({ known: cards.size, shown, active: active() });
  }

  function active() {
    return [...cards.values()].filter(({ job }) => isGoing(job)).length;
  }

  return made;
}
