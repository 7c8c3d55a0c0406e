/** The end mills of the shop, by diameter as in catalogues: plans choose among these. Stored on the server. */

import { api } from "../lib/api.js";
import { freshId, h, replace, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { sentence } from "../lib/words.js";

const INTRO = t("New jobs are planned with these alone. Sizes are diameters in mm, as on the box. Balls make the lens; flat ones only rough.");
const USUAL = t("usual");
const FIELDS = [
  ["diameter", t("Diameter"), "", "radius_mm"],
  ["corner", t("Corner radius"), t("ball"), "corner_radius_mm"],
  ["flute", t("Cutting length"), USUAL, "flute_length_mm"],
  ["shank", t("Shank"), USUAL, "shank_radius_mm"],
  ["stick_out", t("Sticks out"), USUAL, "stick_out_mm"],
  ["flutes", t("Flutes"), "2", "flutes"],
  ["number", t("Tool number"), t("none"), "number"],
];

/** Returns the section's nodes. onChange(): the cutters have changed. */
export function ownCutters({ onChange }) {
  const list = h("ul", { class: "row cutters" }), said = h("p", { class: "fault", role: "alert" });
  const inputs = Object.fromEntries(FIELDS.map(([key, label, placeholder]) => [key, numberInput(label, placeholder)]));
  const add = h("button", { type: "button", disabled: true, onclick: () => send("put", [...tools, asTool()]) }, t("Add"));
  const usual = h("button", { type: "button", class: "quiet", onclick: () => send("delete") }, t("Back to the usual ones"));
  const fields = h("div", { class: "row cutter-fields" }, Object.values(inputs).map(({ node }) => node), add);
  const byField = Object.fromEntries(FIELDS.map(([key, , , field]) => [field, inputs[key].input]));
  let tools = [];
  usual.hidden = true;
  answered(() => api.get("/v1/tools"));

  async function send(method, wanted) {
    if (!(await api.need("jobs:write"))) return;
    if (await answered(() => api[method]("/v1/tools", wanted && { tools: wanted }))) onChange();
  }
  async function answered(ask) {
    try {
      const found = await ask();
      tools = found.tools;
      usual.hidden = !found.own;
      add.disabled = false;
      replace(list, tools.map(shown));
      showRefusal(said, null, byField);
      return true;
    } catch (error) {
      showRefusal(said, error, byField);
      return false;
    }
  }
  function shown(tool) {
    const shape = shapeOf(tool), more = shape === "bull" ? ` R ${round(tool.corner_radius_mm)}` : shape === "flat" ? ` ${t("flat")}` : "";
    const size = `Ø ${round(2 * tool.radius_mm)}${more}`;
    const drop = () => send("put", tools.filter((one) => one !== tool));
    const button = h("button", { type: "button", "aria-label": t`Take away ${size}`, disabled: tools.length === 1, onclick: drop }, "×");
    return h("li", { class: shape, title: t`cuts ${round(tool.flute_length_mm)} mm high, shank Ø ${round(2 * tool.shank_radius_mm)}, sticks out ${round(tool.stick_out_mm)} mm` }, h("span", {}, size), button);
  }
  /** Values left out are those usual for such a cutter. */
  function asTool() {
    const read = (key, usually) => inputs[key].read() ?? usually;
    const diameter = read("diameter", 0), flute = read("flute", 3 * diameter), radius_mm = diameter / 2;
    const corner = read("corner", radius_mm), corner_radius_mm = corner < radius_mm ? corner : null;
    const names = new Set(tools.map(({ name }) => name)), plain = `${shapeOf({ radius_mm, corner_radius_mm })}-r${round(radius_mm)}`;
    const name = [plain, ...tools.map((_, k) => `${plain}-${k + 2}`)].find((one) => !names.has(one)) ?? `${plain}-1`;
    const shank_radius_mm = read("shank", Math.max(diameter, diameter < 3.175 ? 3.175 : 6)) / 2;
    return { name, radius_mm, corner_radius_mm, flute_length_mm: flute, shank_radius_mm, stick_out_mm: read("stick_out", Math.max(30, flute)), flutes: read("flutes", 2), number: read("number", null) };
  }
  return [h("p", { class: "dim" }, INTRO), list, fields, said, usual];
}

function shapeOf({ radius_mm, corner_radius_mm = null }) {
  if (corner_radius_mm === null || corner_radius_mm === radius_mm) return "ball";
  return corner_radius_mm ? "bull" : "flat";
}

/** {node, input, read()}: a number above zero, null if it is left empty. */
export function numberInput(label, placeholder) {
  const input = h("input", { type: "number", min: 0, step: "any", inputMode: "decimal", placeholder });
  const read = () => (input.value === "" ? null : Number(input.value));
  return { node: labelled(label, input), input, read };
}

/** Shows why the server refuses the cutter, and marks the input that the refusal's field names; without an error it clears both. inputs: by field */
export function showRefusal(said, error, inputs) {
  const named = Object.keys(inputs).find((name) => `.${error?.field}`.endsWith(`.${name}`));
  said.id ||= freshId("fault");
  for (const [name, input] of Object.entries(inputs)) {
    input.setAttribute("aria-invalid", String(name === named));
    input.setAttribute("aria-describedby", name === named ? said.id : "");
  }
  write(said, error ? sentence(error.detail ?? error.message) : "");
  inputs[named]?.focus();
}

/** An input below its label. */
export function labelled(label, input) {
  input.id = freshId("shop");
  return h("div", { class: "field" }, h("label", { for: input.id }, label), input);
}

const round = (value) => String(Number(value.toFixed(3)));
