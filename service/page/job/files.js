/** Programs, with the way to the mill, and every other file of a job. */
import { api } from "../lib/api.js";
import { h, replace, svg, write } from "../lib/dom.js";
import { t } from "../lib/language.js";
import { isCut, isGoing, mark, mayBeMilled } from "../lib/state.js";
import { bytes, hours, jobName, thousands } from "../lib/words.js";
import { passWords, passesOf, programRows } from "./figures.js";
import { fold } from "./fold.js";
import { PICTURES } from "./report_pictures.js";
import { saveLink, sheetLink, sheetOf } from "./save.js";

const SHEET = "report.html";
const OFFERED = [
  [SHEET, t("Setup sheet"), t("to print and take to the mill")],
  ["setup-sheet.pdf", t("Setup sheet on one page (PDF)"), t("to hang beside the mill")],
  ...["ngc", "nc", "min"].map((kind) => [`all-passes.${kind}`, t("All programs in one"), t("for a control that changes tools itself")]),
  ["lens.stl", t("Solid of the lens (STL)"), t("to look at in other programs")],
  ["lens.step", t("Exact solid of the lens (STEP)"), t("for a shop with its own CAM")],
  ["lens.stpZ", t("Exact solid of the lens (STEP, packed)"), t("for a shop with its own CAM")],
  ["report.json", t("All figures (JSON)"), ""],
  ["spec.json", t("Settings (JSON)"), t("the job again from a terminal")],
];

const asked = new WeakMap(); // job -> the answer for all parts that show it
const TITLES = new Map(PICTURES.map(({ name, title }) => [name, t(title)]));

/** {node, update(job)}: each program with what it does, and the mills it may go to. */
export function programsPart() {
  const list = h("ol", { class: "programs" });
  const wait = h("p", { class: "dim" });
  const setUp = h("a", { href: "#/machines" }, t("set one up"));
  const noMill = h("p", { hidden: true }, t("No mill is known here yet: "), setUp, t(", or save the programs."));
  const node = fold("programs", t("Programs"), wait, list, noMill);
  let shown = "", mills = null;

  async function update(job) {
    write(wait, waitWords(job));
    wait.hidden = !wait.textContent;
    wait.classList.toggle("soon", !job.programs.length);
    const key = JSON.stringify([job.state, job.cancel_requested, job.programs, programRows(job.report).map((row) => row.time_s)]);
    if (key === shown) return;
    shown = key;
    if (mayBeMilled(job) && !mills) mills = await knownMills();
    noMill.hidden = !mayBeMilled(job) || mills.length > 0;
    const left = await unmilledOf(job);
    if (key === shown) replace(list, job.programs.map((program) => row(job, program, mills ?? [], left)));
  }
  return { node, update };
}

/** Why no program can be sent to a mill yet, or which ones are still to come. */
function waitWords(job) {
  if (job.state === "succeeded") return "";
  if (!job.programs.length) return t("The programs appear here once all of them have been checked.");
  return mayBeMilled(job)
    ? t("All of them have been checked and can be milled. What the milled lens will show is still being worked out.")
    : t("The job was not finished: try again, and they can be sent to a mill once they have been checked.");
}

/** The mills of the shop, real ones first, and of those the ones that are connected. */
export async function knownMills() {
  const last = ({ simulated, mill }) => 2 * Number(simulated) + Number(!mill?.connected);
  try {
    const { machines = [] } = await api.get("/v1/machines");
    return machines.sort((one, other) => last(one) - last(other));
  } catch {
    return []; // the files are of use without a mill, too
  }
}

/** A job's programs that no mill has finished; all of them, where that is not known. */
export function unmilledOf(job) {
  if (!asked.has(job)) asked.set(job, findUnmilled(job));
  return asked.get(job);
}

async function findUnmilled(job) {
  if (!mayBeMilled(job)) return job.programs;
  const { runs } = await api.get(`/v1/runs?job=${job.id}`).catch(() => ({ runs: [] })), done = new Set(runs.filter(isCut).map(({ program }) => program.number));
  return job.programs.filter(({ number }) => !done.has(number));
}

function row(job, program, mills, left) {
  const checked = programRows(job.report).find(({ file }) => file === program.name);
  const pass = checked?.settings ?? passOf(program.name, job);
  const { time_s: seconds, lines } = checked ?? {};
  const size = [lines && t`${thousands(lines)} lines`, bytes(program.bytes)].filter(Boolean).join(", ");
  const alone = mills.length === 1, first = program === left[0];
  const sends = mayBeMilled(job) && mills.map((mill, k) => sendLink(job, program, mill, { alone, first: first && k === 0 }));
  const save = saveLink({ url: program.url, name: program.name, size: program.bytes, words: t("Save"), plain: true });
  return h(
    "li", {},
    cutterShape(pass),
    h("div", { class: "program-what" }, h("div", {}, h("strong", {}, program.name), " ", !left.includes(program) && mark("good", t("milled"))), pass && h("span", {}, passWords(pass)), h("small", { class: "dim" }, size)),
    h("strong", { class: "program-time" }, seconds ? hours(seconds) : ""),
    h("div", { class: "row" }, sends, save),
  );
}

/** The end of the cutter of a pass, to scale up to 12 mm across. */
function cutterShape(pass) {
  const { radius_mm: radius, corner_radius_mm: corner } = pass ?? {};
  if (!radius) return h("span");
  const half = Math.max(1.5, Math.min(15, 2.5 * radius)), round = half * Math.min(1, (corner ?? radius) / radius);
  const end = `M${16 - half} 2V${38 - round}a${round} ${round} 0 0 0 ${round} ${round}H${16 + half - round}a${round} ${round} 0 0 0 ${round} ${-round}V2`;
  return svg("svg", { class: "cutter", viewBox: "0 0 32 40", width: 32, height: 40, "aria-hidden": "true" }, svg("path", { d: end }));
}

/** The pass that a program belongs to, by its name: "pass-2-finish.nc". */
function passOf(name, job) {
  const number = Number(/^pass-(\d+)/.exec(name)?.[1]);
  return passesOf(job)[number - 1];
}

/** The link to a mill's own screen, which offers the following programs, each in its turn. */
export function sendLink(job, program, mill, { alone, first }) {
  const address = `#/machines/${encodeURIComponent(mill.name)}?job=${job.id}&program=${program.number}`;
  const words = alone ? t("Send to mill") : t`Send to ${mill.name}`;
  return h("a", { class: first ? "button primary" : "button", href: address, "aria-label": `${words}: ${program.name}` }, words);
}

/** {node, update(job, artifacts)}: the other files. */
export function filesPart() {
  const list = h("ul", { class: "files" });
  const every = h("ul", { class: "files" });
  const all = h("details", {}, h("summary", {}, t("Every file")), every);
  const archive = h("p", {});
  const node = fold("files", t("Files"), list, archive, all);
  let shown = "";

  function update(job, artifacts) {
    const files = [...artifacts.values()], going = isGoing(job);
    const key = going + files.map(({ name, sha256 }) => name + sha256).join();
    node.hidden = !files.length;
    if (key === shown) return;
    shown = key;
    const offered = OFFERED.filter(([name]) => artifacts.has(name));
    const file = (name) => (name === SHEET ? sheetOf(artifacts) : artifacts.get(name));
    replace(list, offered.map(([name, words, why]) => fileRow(file(name), words, why, name === SHEET)));
    replace(every, files.map((file) => fileRow(file, file.name, TITLES.get(file.name))));
    const total = files.reduce((sum, file) => sum + file.bytes, 0);
    const zip = { url: `/v1/jobs/${job.id}/archive.zip`, name: `${jobName(job)}.zip`, size: total };
    const whole = saveLink({ ...zip, words: t`All files (zip, ${bytes(total)})` });
    replace(archive, going ? t("All of them in one file: when the job is done.") : whole);
    archive.classList.toggle("dim", going);
  }
  return { node, update };
}

function fileRow(file, words, why, isSheet = false) {
  const plain = { url: file.url, name: file.name, size: file.bytes, words, plain: true };
  const link = isSheet ? sheetLink(file, words) : saveLink(plain);
  return h("li", {}, link, h("span", { class: "dim" }, [why, bytes(file.bytes)].filter(Boolean).join(", ")));
}
