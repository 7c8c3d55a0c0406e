/** A job's report in words: pure functions of its JSON, so that all views describe the same figures alike. */
import { t } from "../lib/language.js";
import { ball, hours, mm, passName, within } from "../lib/words.js";
import { alikeWords } from "./eye_words.js";
import { valueWords } from "./setting_words.js";

const WORTH_DB = 0.3;
const MOST_OF_IT = 0.7; // share of the loss by milling from which one cause explains it
const CAUSES = {
  scallops: [t("the grooves between rows"), t("a finer pitch or a bigger ball leaves less of them")],
  steps: [t("the machine's steps"), t("a machine with finer ones leaves less of them")],
  noise: [t("height errors of the machine"), t("a stiffer set-up leaves less of them")],
  screws: [t("the machine's screws"), t("better ones, or axes with linear encoders, leave less of them")],
  haze: [t("the haze of the block"), t("a clearer block, or a better polish of both sides, leaves less of it")],
  back: [t("the waves of the block's back"), t("a block whose back is flatter leaves less of them")],
  rounding: [t("the decimals of the program"), t("a dialect with more of them leaves less")],
};

/** Width and height of the picture on the wall in mm. */
export function screenOf(spec) {
  const { width_mm: wide, height_mm: high, screen_width_mm: sw, screen_height_mm: sh } = spec.optics;
  const width = sw ?? (sh ? (sh * wide) / high : wide);
  return { width, height: sh ?? (width * high) / wide };
}

/** Size of one pixel of the job's picture on the wall, in mm. */
export function pixelMm(spec) {
  return screenOf(spec).width / spec.image.pixels;
}

/** Likeness of a surface's light and the person's picture, in dB; undefined before it is known. */
export function likenessOf(seen) {
  return (seen?.against_original ?? seen)?.seen_db;
}

/**
 * Size of the smallest detail on the wall that still shows, in mm; null before it is known: as finished, where the lens
 * is finished by hand; else twice the rms blur that the tool's marks make, with the disc that the lamp makes of a point,
 * and never less than a pixel.
 */
export function smallestDetail(spec, report) {
  if (report?.as_finished?.smallest_detail_mm !== undefined) return report.as_finished.smallest_detail_mm;
  const milled = report?.as_milled, pixel = pixelMm(spec), known = milled?.blur_x_px !== undefined;
  const marks = known ? Math.hypot(milled.blur_x_px, milled.blur_y_px) * pixel : report?.plan?.blur_mm;
  if (marks === undefined) return null;
  return Math.max(pixel, Math.hypot(2 * marks, report.optics?.tolerances?.blur_mm ?? 0));
}

/** The same for a plan of which only the rms blur is known. */
export function detailOfPlan(spec, row) {
  return Math.max(pixelMm(spec), 2 * row.blur_mm);
}

/** The report's rows of all programs, in the order in which they are run: facing, passes, marks, cutting out. */
export function programRows(report) {
  const { face, witness, "cut-out": cutOut } = report?.around ?? {};
  return [face, ...(report?.passes ?? []), witness, cutOut].filter(Boolean);
}

/** Seconds on the mill of all programs; null before they are known. */
export function millSeconds(report) {
  const passes = programRows(report);
  return passes.length && passes.every((row) => row.time_s) ? passes.reduce((sum, row) => sum + row.time_s, 0) : null;
}

/** The main figures of a job: [[what, figure, words]], as many as are known. predicted: its likeness. */
export function headlines(spec, report, predicted) {
  const found = [], detail = smallestDetail(spec, report), milled = report?.as_milled, seconds = millSeconds(report);
  const made = report?.passes?.length ?? 0, wanted = Math.max(made, passesOf({ spec, report }).length);
  const known = made < wanted ? t`${made} of ${wanted} passes so far` : made === 1 ? t`${made} pass` : t`${made} passes`;
  if (seconds !== null) found.push([t("On the mill"), hours(seconds), known]);
  else if (report?.plan?.hours) found.push([t("On the mill"), hours(report.plan.hours * 3600), t("as planned")]);
  if (detail !== null) found.push([t("Sharpness"), t`details under ${mm(detail)} will blur`, sharpnessWords(spec, detail)]);
  found.push(...seenByHand(report) ?? onTheWall(likenessOf(milled), likenessOf(report?.optics), predicted, report?.finishing));
  if (report?.optics?.relief_mm !== undefined) {
    const steep = t`steepest slope ${report.optics.max_slope_deg.toFixed(0)}°`;
    found.push([t("Depth of the lens"), mm(report.optics.relief_mm), steep]);
  }
  return found;
}

/** The likeness after finishing by hand, and before; null if it is not known. */
function seenByHand(report) {
  const seen = likenessOf(report?.as_finished), milled = likenessOf(report?.as_milled);
  if (seen === undefined) return null;
  const before = milled === undefined ? [] : [[t("On the wall, straight from the mill"), alikeWords(milled)]];
  return [[t("On the wall, as finished"), alikeWords(seen), t("after the work by hand below")], ...before];
}

/** The likeness on the wall, of a lens that will be finished by hand without the marks, too; one sharpened for the marks of its tool shows less without them. */
function onTheWall(milled, polished, predicted, finishing) {
  const seen = milled ?? predicted ?? null, how = milled === undefined ? t("as predicted; the last steps simulate it") : "";
  const shown = polished === undefined || !finishing ? [] : [[t("On the wall, if polished"), alikeWords(polished)]];
  if (seen === null) return shown.map((row) => [...row, t("as milled it may be less; the last steps show how much")]);
  if (polished < seen) return [[t("On the wall"), alikeWords(seen), how || t("Do not polish it: it is made for the tool's marks.")]];
  return [[milled === undefined ? t("On the wall") : t("On the wall, as milled"), alikeWords(seen), how], ...shown];
}

const SCORES = [
  ["psnr_db", t("Likeness (PSNR)"), (value) => `${value.toFixed(1)} dB`],
  ["ssim", t("Likeness of structure (SSIM)"), (value) => t`${value.toFixed(3)} of 1`],
  ["misplaced_light", t("Light in wrong places"), (value) => `${(100 * value).toFixed(1)} %`],
  ["dark_leak", t("Light where it should be dark"), (value) => `${(100 * value).toFixed(2)} %`],
];

/** The surfaces that experts compare: [[what it is called, its part of the report]]. */
export function expertSides(report) {
  const finished = report?.as_finished ? [[t("as finished"), report.as_finished]] : [];
  return [...finished, [t("as milled"), report?.as_milled], [t("the lens itself"), report?.optics]];
}

/** The figures by which experts compare them: [[what, of each surface]], "–" where one is not known. */
export function expertFigures(report) {
  const sides = expertSides(report).map(([, side]) => side);
  const known = SCORES.filter(([key]) => sides.some((side) => side?.[key] !== undefined));
  return known.map(([key, what, say]) => [what, ...sides.map((side) => (side?.[key] === undefined ? "–" : say(side[key])))]);
}

/** The light for which all of them hold; null if an old report does not state it. */
export function lightSentence(report) {
  const words = report?.optics?.light?.words;
  return words ? t`All these figures hold under ${words}.` : null;
}

function sharpnessWords(spec, detail) {
  const { width } = screenOf(spec);
  return t`of a picture ${mm(width)} wide: about ${Math.max(1, Math.round(width / detail))} details across`;
}

/**
 * The largest cause of loss in the milled picture, as a sentence; null if nothing stands out. Marks hide each other: if
 * one is taken away the others stay, so the single gains do not add up to the whole loss.
 */
export function mainCause(report) {
  const { as_milled: milled, optics } = report ?? {};
  const [first, next] = Object.entries(milled?.gain_db_without ?? {}).sort((a, b) => b[1] - a[1]);
  const [cause, gain] = first ?? [];
  if (!(gain >= WORTH_DB) || !(cause in CAUSES)) return null;
  const [what, less] = CAUSES[cause], lost = optics?.psnr_db - milled.psnr_db;
  const most = t`Most of the loss comes from ${what}: ${less}.`;
  if (!(lost > 0) || gain >= MOST_OF_IT * lost) return most;
  const other = next && next[0] in CAUSES ? t`, ${CAUSES[next[0]][0]} first,` : "";
  return t`Milling costs ${lost.toFixed(1)} dB. The largest part comes from ${what} (${less}), but without them alone only ${gain.toFixed(1)} dB would come back, because the other marks${other} hide as much.`;
}

/** Whether the lens draws more than the picture, for the blur of its tool's marks. */
export function isSharpened({ spec, report }) {
  return (report?.plan ?? spec.optics).foreseen_blur_mm.some((blur) => blur > 0);
}

/** How exactly the wall must be placed, as a sentence; null if that was not simulated. */
export function focusSentence(report) {
  const range = report?.optics?.tolerances?.focus_range_mm;
  if (!range) return null;
  return t`The picture stays sharp from ${mm(-range[0])} too near to ${mm(range[1])} too far.`;
}

/** The passes of a job; those that were planned are in its report. */
export function passesOf(job) {
  return job.spec.passes?.length ? job.spec.passes : (job.report?.plan?.passes ?? []);
}

const TOOLS = { flat: t("flat"), ball: t("ball") };

/** One pass of a spec in words: "ball R 3 (Ø 6 mm), rows along X every 0.14 mm at 1500 mm/min". */
export function passWords(row) {
  if ("above_mm" in row) return t`${TOOLS[row.tool] ?? row.tool} end mill ${ball(row.radius_mm)}, takes ${mm(row.above_mm)} off the top`;
  if ("tabs" in row) return cutOutWords(ball(row.radius_mm), row.tabs);
  const tool = toolWords(row);
  if (!row.pitch_mm) return t`${tool}, mills ripples beside the lens: each is gone at a known minute of the work by hand`;
  const rows = t`rows along ${String(row.direction ?? "x").toUpperCase()}`;
  const ways = row.strategy === "contour" ? t("one path along contour lines") : rows;
  const only = row.where === "rest" ? t(", only where stock is left") : "";
  const leave = row.stock_to_leave_mm ? t`, leaves ${mm(row.stock_to_leave_mm)}` : "";
  return t`${tool}, ${ways} every ${mm(row.pitch_mm)} at ${row.feed_mm_per_min} mm/min${only}${leave}`;
}

function toolWords({ radius_mm, corner_radius_mm = null }) {
  const size = ball(radius_mm);
  if (corner_radius_mm === null || corner_radius_mm === radius_mm) return t`ball ${size}`;
  return corner_radius_mm ? t`bull-nose end mill ${size}` : t`flat end mill ${size}`;
}

function cutOutWords(size, tabs) {
  if (tabs === 1) return t`flat end mill ${size}, cuts the lens out, ${tabs} tab`;
  return t`flat end mill ${size}, cuts the lens out, ${tabs} tabs`;
}

/** The lens and its set-up in one line. */
export function setUpWords(spec) {
  const { optics } = spec, screen = screenOf(spec);
  const kind = optics.surface === "mirror" ? t("mirror") : t("lens");
  const block = t`${round(optics.width_mm)} × ${round(optics.height_mm)} mm ${kind}`;
  const wall = t`wall at ${mm(optics.throw_mm)}`;
  const size = t`, picture ${round(screen.width)} × ${round(screen.height)} mm`;
  const enlarged = Math.abs(screen.width - optics.width_mm) > 0.5 ? size : "";
  const source = within(valueWords("optics.light.kind", optics.light.kind)), away = optics.light.distance_mm;
  const light = away == null ? t`light: ${source}` : t`light: ${source}, ${mm(away)} away`;
  return `${block}, ${wall}${enlarged}, ${light}`;
}

function round(length) {
  return +length.toFixed(1);
}

const STAGES = {
  image: t("Read the picture"),
  irradiance: t("Set the light it needs"),
  passes: t("Plan the passes"),
  map: t("Shape the lens"),
  heightfield: t("Check its surface"),
  caustic: t("Simulate its light"),
  fit: t("Check that tools and block fit"),
  "pass-face": t("Make and check the facing of the block"),
  "pass-witness": t("Make and check the witness marks"),
  "pass-cut-out": t("Make and check the cutting out"),
  check: t("Check the programs as the mill reads them"),
  "as-milled": t("Simulate the milled lens"),
  "as-finished": t("Simulate the finished lens"),
  report: t("Write the setup sheet"),
};

/** What a stage does, for people. */
export function stageWords(name, spec) {
  const pass = /^pass-(\d+)$/.exec(name);
  if (!pass) return STAGES[name] ?? name;
  const row = spec.passes?.[Number(pass[1]) - 1];
  return t`Make and check pass ${pass[1]}${row ? ` (${passName(row.name)})` : ""}`;
}
