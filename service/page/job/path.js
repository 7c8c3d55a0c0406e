/** The tool path of each pass: drawn whole, looked at closely, and played through in time. */
import { api } from "../lib/api.js";
import { h, replace, whenSeen, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { bytes, hours, mm, passName } from "../lib/words.js";
import { fold } from "./fold.js";
import { openPath } from "./path_file.js";
import { pathView } from "./path_view.js";

const STEPS = 10_000;
const LABEL = t("Tool path from above. Arrow keys move it, plus and minus zoom, 0 shows all.");
const PLAY_S = 40; // for a whole pass

/** {node, update(artifacts, spec), free()} */
export function pathPart() {
  const passes = h("div", { class: "choice", role: "radiogroup", "aria-label": t("Pass") });
  const place = h("p", { class: "path-place mono" });
  const note = h("p", { class: "path-note dim" });
  const range = h("input", { type: "range", min: 0, max: STEPS, value: STEPS, "aria-label": t("Time in the pass") });
  const clock = h("p", { class: "path-clock" });
  const player = h("button", { type: "button", onclick: () => play(!playing) }, t("Play"));
  const rapids = h("input", { type: "checkbox", checked: true, onchange: () => view?.rapids(rapids.checked) });
  const tools = h(
    "div", { class: "path-tools" },
    h("button", { type: "button", class: "square", "aria-label": t("Zoom in"), onclick: () => view?.zoom(1.6) }, "+"),
    h("button", { type: "button", class: "square", "aria-label": t("Zoom out"), onclick: () => view?.zoom(1 / 1.6) }, "−"),
    h("button", { type: "button", onclick: () => view?.fit() }, t("Whole lens")),
  );
  const frame = h("div", { class: "path-place-of-frame" });
  const key = (kind, words) => h("li", {}, h("span", { class: `path-key ${kind}` }), words);
  const kinds = [key("done", t("cut")), key("coming", t("still to come")), key("rapid", t("in the air"))];
  const body = h(
    "div", { class: "path-body" }, frame, tools,
    h("div", { class: "path-time" }, player, h("div", { class: "path-slider" }, range, clock)),
    h("div", { class: "row spread" }, place, h("label", { class: "tick" }, rapids, t("Show moves in the air"))),
    h("ul", { class: "path-legend" }, kinds), note,
  );
  const node = fold("path", t("Tool path"), passes, body);
  let view = null, file = null, chosen = "", offered = "", outline = [], playing = 0, freed = false;
  const files = new Map();
  const stop = whenSeen(body, load, (seen) => !seen && play(false));
  range.addEventListener("input", () => (play(false), at()));

  async function load() {
    if (!files.size) return;
    if (!files.has(chosen)) chosen = [...files.keys()].at(-1);
    const wanted = files.get(chosen);
    if (file?.sha256 === wanted.sha256) return;
    write(note, t`Loading ${bytes(wanted.bytes)}: first the outline, then what is looked at.`);
    try {
      const part = (from, to, signal) => api.bytes(wanted.url, { from, to: Math.min(to, wanted.bytes), signal });
      const opened = await openPath(part);
      if (freed || files.get(chosen) !== wanted) return;
      file = Object.assign(opened, { sha256: wanted.sha256 });
    } catch (error) {
      write(note, t`The path could not be read. ${error.detail ?? error.message}`);
      return;
    }
    view ??= pathView({ label: LABEL, outline, onDrawn });
    if (!view.node.isConnected) frame.append(view.node);
    range.value = STEPS;
    view.show(file);
    at();
  }
  function onDrawn({ number, sharp }) {
    const { levels } = file.head, whole = number === levels.length - 1;
    frame.dataset.level = number;
    if (whole || sharp) write(note, whole ? t("Every move is drawn.") : t("Drawn as finely as this screen can show it."));
    else write(note, t`Moves within ${mm(levels[number].tolerance_mm)} of each other are drawn as one. Zoom in to see each.`);
  }
  function at() {
    if (!file) return;
    const end = file.head.time_s, share = Number(range.value) / STEPS, time = share * end;
    const tool = view.time(share >= 1 ? Infinity : time);
    const text = share >= 1 ? t`whole pass, ${hours(end)}` : t`${hours(time)} of ${hours(end)}`;
    write(clock, text);
    range.setAttribute("aria-valuetext", text);
    const where = tool && `X ${tool.x.toFixed(2)}  Y ${tool.y.toFixed(2)}  Z ${tool.z.toFixed(3)}`;
    write(place, tool ? t`${where}  line ${tool.line} of ${file.lines}` : "");
  }
  function play(on) {
    cancelAnimationFrame(playing);
    playing = 0;
    player.textContent = on ? t("Pause") : t("Play");
    if (!on || !file) return;
    if (Number(range.value) >= STEPS) range.value = 0;
    let last = performance.now(), done = Number(range.value);
    const step = (now) => {
      done += ((now - last) / 1000 / PLAY_S) * STEPS;
      last = now;
      range.value = done;
      at();
      if (done >= STEPS) play(false);
      else playing = requestAnimationFrame(step);
    };
    playing = requestAnimationFrame(step);
  }
  function update(artifacts, spec) {
    outline = outlineOf(spec);
    files.clear();
    for (const [name, artifact] of artifacts) if (/^pass-\d+\.path$/.test(name)) files.set(name, artifact);
    node.hidden = !files.size;
    const key = [...files.values()].map((each) => each.sha256).join();
    if (key === offered) return;
    offered = key;
    if (!files.has(chosen)) chosen = [...files.keys()].at(-1);
    replace(passes, [...files.keys()].map((name) => choice(name, spec)));
    stop.again();
  }
  function choice(name, spec) {
    const number = Number(/\d+/.exec(name)[0]), row = spec.passes?.[number - 1];
    const take = () => {
      chosen = name;
      play(false);
      load();
    };
    const input = h("input", { type: "radio", name: "pass", value: name, checked: name === chosen, onchange: take });
    return h("label", {}, input, h("span", {}, t`Pass ${number}${row ? `: ${passName(row.name)}` : ""}`));
  }
  return {
    node, update,
    free() {
      freed = true;
      play(false);
      stop.end();
      view?.free();
    },
  };
}

/** Corners of the lens in mm, from the spec. */
export function outlineOf({ optics }) {
  const { width_mm: w, height_mm: h_, outline } = optics;
  if (Array.isArray(outline)) return outline;
  if (outline !== "ellipse") return [[0, 0], [w, 0], [w, h_], [0, h_]];
  return Array.from({ length: 96 }, (_, k) => {
    const turn = (2 * Math.PI * k) / 96;
    return [(w / 2) * (1 + Math.cos(turn)), (h_ / 2) * (1 + Math.sin(turn))];
  });
}
