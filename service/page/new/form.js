/** The form of a new job: rows that make a spec, and a spec that fills the rows. */

import { h, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { sentence } from "../lib/words.js";
import { EXPERT, LIGHT, MAIN, MILL, PICTURE, START } from "./fields.js";
import { withProfiles } from "./machines.js";
import { passes } from "./passes.js";
import { readRow, row } from "./row.js";
import { put, same, valueAt } from "./spec.js";

const OTHERS = {
  key: "rest",
  label: t("Other values, as JSON"),
  hint: t("For keys without a field: {\"optics\": {\"outline\": [[0, 0], [50, 0], [25, 40]]}}"),
  kind: "json",
};
const OWN = ["machine.profile", "stock.thickness_mm", "finish.process"];
const ONE_OPEN = "causticmill-settings"; // of the folds with one name, one is open
const GREYED = ["main", "mill"]; // cards whose rows stay in their places
const PLANNED_ONLY = t("Only “Recommended” can keep to that.");

/**
 * {own, main, picture: elements; own: what a person has; settings: element with all others; isUsual(group), read(), show(spec), blame(problems)}.
 * profiles: [{name, description, mills}] of the machines; onChange(): a person changed something; planned(): the passes as far
 * as the server describes them; last: a row that is not part of the spec.
 */
export function specForm({ profiles, onChange, planned, last }) {
  const changed = () => {
    reveal();
    onChange();
  };
  const make = (fields) => fields.map((field) => row(withProfiles(field, profiles), { onChange: () => (keepShape(field.key), changed()) }));
  const groups = { main: make(MAIN), light: make(LIGHT), mill: make(MILL), picture: make(PICTURE) };
  const more = EXPERT.map(([title, fields]) => [title, make(fields)]);
  const rows = [...Object.values(groups).flat(), ...more.flatMap(([, made]) => made)];
  const milling = passes({ onChange: changed, known: planned });
  const rest = row(OTHERS, { onChange: changed });
  const [width, height, finish] = ["optics.width_mm", "optics.height_mm", "finish.process"].map((wanted) => rows.find(({ key }) => key === wanted));
  const shape = { ratio: 1, byHand: false, wasBest: false }; // wasBest: the finish, until nobody was there to choose it

  /** The height follows the width as long as nobody has set it. */
  function keepShape(changedKey) {
    const [wide, high] = [width, height].map((one) => safely(one.read));
    if (changedKey === height.key) shape.byHand = high !== undefined;
    if (changedKey !== width.key || !(wide > 0) || shape.byHand) return;
    height.show(+(wide * shape.ratio).toFixed(3));
    height.blame("");
  }

  /** Only the planner can choose a finish, and it plans no passes that a person has given. */
  function keepFinish({ preset, passes }) {
    const isPlanned = preset === START.preset && !passes, now = finish.read(), best = START.finish.process;
    if (!isPlanned && now === best) finish.show();
    if (isPlanned && now === undefined && shape.wasBest) finish.show(best);
    shape.wasBest = !isPlanned && (now === best || (now === undefined && shape.wasBest));
    finish.offer(best, isPlanned);
  }

  /** Show a row only while it has a meaning, or grey it; give a start value to a row that appears empty and needs one. */
  function reveal() {
    keepFinish(read().spec);
    const { spec } = read();
    for (const one of rows.filter(({ field }) => field.when)) {
      const there = one.field.when(spec);
      if (there && one.element.hidden && one.field.start && safely(one.read) === undefined) one.show(one.field.start);
      if (GREYED.includes(one.field.card)) one.disable(there ? "" : PLANNED_ONLY);
      else one.element.hidden = !there;
    }
    settings.update(spec);
  }

  /** {spec: values that differ from the usual, faults: [{row, words}]}; a later row may decide whether a row is shown. */
  function read() {
    let asked = rows, count, faults, spec;
    while (asked.length !== count) {
      count = asked.length;
      faults = [];
      spec = readRow(rest, faults) ?? {};
      for (const one of asked) {
        const value = readRow(one, faults);
        if (value !== undefined && (!same(value, one.field.usual) || valueAt(START, one.key) !== undefined)) spec = put(spec, one.key, value);
      }
      asked = asked.filter(({ field }) => !field.when || field.when(spec));
    }
    const list = milling.read(faults);
    return { spec: list ? { ...spec, passes: list } : spec, faults };
  }

  /** Fill the form; values without a row go into the text of other values. */
  function show(spec) {
    const left = structuredClone(spec);
    for (const one of rows) {
      const value = valueAt(left, one.key) ?? undefined;
      const known =
        value === undefined || one.field.kind !== "choice" || one.field.choices.some(([choice]) => choice === value);
      one.show(known ? value : undefined);
      if (known) put(left, one.key, undefined);
    }
    milling.show(left.passes?.length ? left.passes : null);
    delete left.passes;
    rest.show(Object.keys(left).length ? left : undefined);
    shape.wasBest = false;
    shape.ratio = (safely(width.read) > 0 && safely(height.read) / width.read()) || 1;
    reveal();
  }

  /** Puts each problem {field: "spec.KEY", detail, use} beside its row; gives back {placed: rows from the top, unplaced}. */
  function blame(problems) {
    const all = [...rows, ...milling.rows(), rest];
    const faults = new Map();
    const unplaced = [];
    for (const problem of problems) {
      const key = problem.field.startsWith("spec.") ? problem.field.slice("spec.".length) : "";
      const found = rowFor(all, key) ?? (valueAt(readRow(rest, []), key) !== undefined && rest);
      if (found) faults.set(found, [...(faults.get(found) ?? []), problem]);
      else unplaced.push(problem);
    }
    for (const one of all) {
      const own = faults.get(one) ?? [];
      const { use } = own.find(({ field }) => field === `spec.${one.key}`) ?? {};
      one.blame(own.map(({ detail }) => sentence(detail)).join(" "), use);
    }
    return { placed: [...faults.keys()].sort(compareDown), unplaced };
  }

  /** Whether all rows of "main", "light"... are as usual. */
  function isUsual(group) {
    const { spec } = read();
    return groups[group].every((one) => valueAt(spec, one.key) === undefined);
  }

  const fields = (made) =>
    h(
      "div",
      { class: "fields" },
      made.map((one) => one.element),
    );
  const group = (title, made, ...others) => ({ title, keys: [...made.map(({ key }) => key), ...others.map(({ key }) => key)], content: [made.length > 0 && fields(made), others.map(({ element }) => element)] });
  const settings = allSettings([
    group(t("Light"), groups.light),
    group(t("Milling"), groups.mill, milling),
    ...more.map(([title, made]) => group(title, made)),
    group(t("Everything else"), [], last, rest),
  ]);
  reveal();
  const isOwn = ({ key }) => OWN.includes(key);
  return {
    own: fields(groups.main.filter(isOwn)),
    main: fields(groups.main.filter((one) => !isOwn(one))),
    picture: fields(groups.picture),
    settings: settings.element,
    isUsual,
    read,
    show,
    blame,
  };
}

/** The row a key belongs to: its own, or that of the list or table it lies in. Another row would be the wrong one. */
function rowFor(rows, key) {
  const shown = rows.filter(({ element }) => !element.hidden);
  const parts = key.split(".");
  for (let length = parts.length; length > 0; length -= 1) {
    const found = shown.find((one) => one.key === parts.slice(0, length).join("."));
    if (found) return found;
  }
  return undefined;
}

function compareDown(one, other) {
  return one.element.compareDocumentPosition(other.element) & Node.DOCUMENT_POSITION_FOLLOWING ? -1 : 1;
}

/** Focus on a row and unfold everything around it. */
export function focusRow(row) {
  for (let part = row.element; part; part = part.parentElement) part.classList.remove("unfound");
  for (let fold = row.element.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  row.focus();
}

function safely(read) {
  try {
    return read();
  } catch {
    return null;
  }
}

/**
 * {element, update(spec)}: groups, {title, keys of the spec, content}, of which one is unfolded; during a search, all groups with matches.
 * update: each says how many of its keys differ from the usual.
 */
function allSettings(groups) {
  const parts = groups.map(({ title, content }) => {
    const count = h("small");
    return { count, node: h("details", { name: ONE_OPEN }, h("summary", {}, h("h3", {}, title), count), h("div", { class: "stack" }, content)) };
  });
  const find = () => {
    const wanted = search.value.trim().toLowerCase(), lacks = (one) => !`${one.dataset.key ?? ""} ${one.textContent}`.toLowerCase().includes(wanted);
    for (const { node } of parts) {
      const all = !lacks(node.firstChild);
      for (const one of node.querySelectorAll(".field")) one.classList.toggle("unfound", !all && lacks(one));
      const found = Boolean(node.querySelector(".field:not(.unfound)"));
      node.name = wanted ? "" : ONE_OPEN;
      node.open = Boolean(wanted) && found;
      node.classList.toggle("unfound", !found);
    }
  };
  const search = h("input", { type: "search", placeholder: t("Search"), "aria-label": t("Search all settings"), oninput: find });
  return {
    element: h("div", { class: "expert" }, search, parts.map(({ node }) => node)),
    update(spec) {
      groups.forEach(({ keys }, k) => {
        const changed = keys.filter((key) => !same(valueAt(spec, key), valueAt(START, key))).length;
        write(parts[k].count, changed ? t`${changed} changed` : "");
      });
    },
  };
}
