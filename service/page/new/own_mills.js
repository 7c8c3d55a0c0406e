/** Mills of the shop for which programs can be made: the known mill that each resembles, and the differences. Stored on the server. */

import { api } from "../lib/api.js";
import { h } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { labelled, numberInput, showRefusal } from "./cutters.js";

const INTRO = t("Say what differs from a mill that is known here. What you leave empty is as in that one. Plans, programs and checks follow it.");
const AXES = ["X", "Y", "Z"];
const FIGURES = [["step_mm", t("Smallest step, µm"), 1000], ["z_noise_mm", t("Height error, µm"), 1000], ["collet_mm", t("Collet takes, mm"), 1], ["spindle_w", t("Spindle, W"), 1]];

/** Returns the section's nodes. profiles: those of the server; onChanged(profiles, name): the profiles have changed; name: the one added or changed, null after a removal. */
export function ownMills({ profiles, onChanged }) {
  const known = profiles.filter(({ built_in }) => built_in), own = profiles.filter(({ stated }) => stated);
  const name = textInput(t("Name"), { maxLength: 40 }), words = textInput(t("What it is"), { maxLength: 300 });
  const like = h("select", { onchange: showUsual }, known.map((one) => h("option", { value: one.name }, one.name)));
  const travel = AXES.map((axis) => numberInput(t`Travel ${axis}, mm`, ""));
  const speeds = [numberInput(t("Slowest, rpm"), ""), numberInput(t("Fastest, rpm"), "")];
  const figures = FIGURES.map(([key, label, factor]) => ({ key, factor, ...numberInput(label, "") }));
  const said = h("p", { class: "fault", role: "alert" });
  const keep = h("button", { type: "button", onclick: save }, t("Keep this mill"));
  const fields = [name.node, labelled(t("Most like"), like), words.node, ...[...travel, ...figures, ...speeds].map(({ node }) => node), keep];
  const each = (key, inputs) => inputs.map(({ input }, k) => [`${key}.${k}`, input]);
  const byField = Object.fromEntries([
    ["profile", name.input], ["extends", like], ["description", words.input],
    ...each("travel_mm", travel), ...each("spindle_rpm", speeds), ...figures.map(({ key, input }) => [key, input]),
    ["travel_mm", travel[0].input], ["spindle_rpm", speeds[0].input],
  ]);
  const list = h("ul", { class: "row cutters", hidden: !own.length }, own.map(shown));
  showUsual();

  /** The value of a field that is left empty. */
  function showUsual() {
    const base = known.find((one) => one.name === like.value);
    if (!base) return;
    const hint = ({ input }, value) => (input.placeholder = value == null ? "" : String(round(value)));
    travel.forEach((field, k) => hint(field, base.travel_mm[k]));
    speeds.forEach((field, k) => hint(field, base.spindle_rpm[k]));
    figures.forEach((field) => hint(field, base[field.key] == null ? null : base[field.key] * field.factor));
  }
  function shown(one) {
    const show = h("button", { type: "button", title: t`Change ${one.name}`, onclick: () => edit(one) }, one.name);
    const drop = () => send(() => api.delete(addressOf(one.name)), null);
    return h("li", {}, show, h("button", { type: "button", "aria-label": t`Take away ${one.name}`, onclick: drop }, "×"));
  }
  function edit({ name: called, stated }) {
    name.input.value = called;
    like.value = stated.extends;
    words.input.value = stated.description ?? "";
    const put = ({ input }, value) => (input.value = value == null ? "" : String(round(value)));
    travel.forEach((field, k) => put(field, stated.travel_mm?.[k]));
    speeds.forEach((field, k) => put(field, stated.spindle_rpm?.[k]));
    figures.forEach((field) => put(field, stated[field.key] == null ? null : stated[field.key] * field.factor));
    showUsual();
    name.input.focus();
  }
  /** Figures that belong together are stated together; fields left empty get their usual values. */
  function whole(inputs, usual) {
    const read = inputs.map((field) => field.read());
    return read.every((value) => value === null) ? undefined : read.map((value, k) => value ?? usual[k]);
  }
  function save() {
    const called = name.input.value.trim();
    if (!called) return showRefusal(said, { field: "profile", detail: t("It needs a name.") }, byField);
    const base = known.find((one) => one.name === like.value);
    const body = { extends: like.value, description: words.input.value.trim() || undefined };
    Object.assign(body, { travel_mm: whole(travel, base.travel_mm), spindle_rpm: whole(speeds, base.spindle_rpm) });
    for (const { key, factor, read } of figures) body[key] = read() === null ? undefined : round(read() / factor);
    return send(() => api.put(addressOf(called), body), called);
  }
  async function send(ask, called) {
    if (!(await api.need("machine:run"))) return;
    try {
      onChanged((await ask()).profiles, called);
    } catch (error) {
      showRefusal(said, error, byField);
    }
  }
  return [h("p", { class: "dim" }, INTRO), list, h("div", { class: "row cutter-fields" }, fields), said];
}

function textInput(label, attributes) {
  const input = h("input", { type: "text", ...attributes });
  return { input, node: labelled(label, input) };
}

const addressOf = (name) => `/v1/profiles/${encodeURIComponent(name)}`;
const round = (value) => Number(value.toPrecision(12));
