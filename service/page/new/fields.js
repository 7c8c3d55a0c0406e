/**
 * The keys of the job spec as rows of the form: the one list from which inputs, hints and the spec are made.
 *
 * A row is {key, label, kind, usual} and more. kind: "number", "whole" (number), "choice", "tick", "text", or "numbers"
 * (one for each of `names`). usual: what counts where the field is empty; a text where the server works it out. hint,
 * unit: words. when(spec): the row is there only then. start: what it holds when it appears. filled: the usual value
 * stands in the field. wide: it has a line of its own. look: "cards" for a choice with words about each.
 */

import { eyeWords } from "../job/figures.js";
import { capital } from "../lib/words.js";

const XYZ = ["X", "Y", "Z"];
const OF_MACHINE = "machine's";
export const MACHINE_USUAL = "grbl";

const number = (key, label, unit, usual, more) => ({ key, label, kind: "number", unit, usual, ...more });
const whole = (key, label, usual, more) => ({ key, label, kind: "whole", usual, ...more });
const numbers = (key, label, unit, names, more) => ({ key, label, kind: "numbers", unit, names, usual: null, ...more });
const tick = (key, label) => ({ key, label, kind: "tick", usual: false });
const choice = (key, label, choices, usual, more) => ({ key, label, kind: "choice", choices, usual, ...more });

const recommended = (spec) => spec.preset === "recommended";
const lamp = (spec) => spec.optics?.light?.kind === "point";
const prepared = (spec) => spec.image?.prepare === "detail";
const sun = (spec) => spec.optics?.light?.kind === "sun";

export const LENS = [
  number("optics.width_mm", "Width", "mm", 100, { filled: true }),
  number("optics.height_mm", "Height", "mm", 100, { filled: true }),
  number("optics.throw_mm", "Distance to the wall", "mm", 100, { filled: true }),
  number("optics.screen_width_mm", "Picture width on the wall", "mm", "like the lens"),
];

const LIGHTS = [
  ["collimated", "Parallel", "a spotlight far away, or a collimated lamp"],
  ["sun", "Sun", "half a degree wide: about 1 mm of blur for every 110 mm to the wall"],
  ["point", "Lamp", "a small bright lamp close by"],
];

export const LIGHT = [
  choice("optics.light.kind", "What shines on the lens", LIGHTS, "collimated", { look: "cards" }),
  number("optics.light.distance_mm", "Lamp to the lens", "mm", "needed", { start: "1000", when: lamp }),
  number("optics.light.size_mm", "Size of the lamp", "mm", 0, { when: lamp, hint: "Its diameter; 0 is a point." }),
  number("optics.light.size_deg", "Size of the sun in the sky", "°", 0.53, { when: sun }),
];

const PRESETS = [
  ["recommended", "Recommended", "passes planned for this picture and machine: the best light for the time"],
  ["draft", "Draft", "one rough and one coarse finish: quick, to see whether it works"],
  ["paper", "Paper", "the three passes of the published method: very fine, slow"],
];
const LIKENESSES = [
  [null, "any"],
  [21, "recognisable (21 dB)"],
  [27, "plain (27 dB)"],
  [33, "good (33 dB)"],
  [40, "very close (40 dB)"],
].map(([level, words]) => [level, words, level ? `${capital(eyeWords(level))}.` : ""]);
const HOURS = { when: recommended, hint: "On the mill, all passes." };
const BLUR = { when: recommended, hint: "On the wall. Instead of a time." };
const LIKENESS = { when: recommended, hint: "Of the wall to the picture. Instead of a time." };

const FINISHES = [
  ["none", "no: as the mill leaves it"],
  ["best", "yes, whatever shows most"],
  ["felt", "felt and compound"],
  ["sanding", "wet sanding on a soft block"],
  ["lacquer", "a thin coat of lacquer"],
];
const FINISH = { wide: true, hint: "Half an hour takes the mill's marks off. The lens is made for it; minutes and steps are on the sheet." };

export const MILL = [
  choice("machine.profile", "Machine", [["grbl", "grbl"]], MACHINE_USUAL, { wide: true, named: "profiles" }),
  choice("preset", "How fine", PRESETS, "paper", { look: "cards" }),
  number("plan.hours", "Time at most", "h", "no limit", HOURS),
  number("plan.blur_mm", "Blur at most", "mm", "any", BLUR),
  choice("plan.psnr_db", "Likeness to reach", LIKENESSES, null, LIKENESS),
  choice("finish.process", "Finished by hand", FINISHES, "none", FINISH),
];

const TONES = [["srgb", "as photos are (sRGB)"], ["linear", "linear light"]];
const FITS = [["crop", "choose a part"], ["pad", "whole picture, dark around"], ["stretch", "stretch"]];

const PREPARED = [["none", "no, as it is"], ["detail", "yes: faces and detail brought out"]];
const PREPARING = "Contrast is raised in what is just large enough to show. The job shows both pictures beside each other.";
const DETAIL = "As the estimate says it. Empty: about 1 mm for every 100 mm to the wall.";

export const PICTURE = [
  choice("image.tone", "Tones are meant", TONES, "srgb", { wide: true }),
  choice("image.fit", "Where proportions differ", FITS, "crop", { wide: true }),
  tick("image.invert", "Negative"),
  choice("image.prepare", "Prepared for the wall", PREPARED, "none", { wide: true, hint: PREPARING }),
  number("image.prepare_detail_mm", "Smallest detail that will show", "mm", "by the wall", { when: prepared, hint: DETAIL }),
];

const VIEWS = [["lens", "on a wall"], ["behind", "from behind"]];
const METHODS = [["transport", "optical path"], ["paper", "as published"]];
const BRANCHES = [["auto", "automatic"], ["direct", "straight"], ["inverted", "crossing"]];
const SHAPES = [["rectangle", "rectangle"], ["ellipse", "ellipse"]];
const SURFACES = [["lens", "lens"], ["mirror", "mirror"]];
const INDEX = { hint: "How strongly the material bends light: acrylic 1.49." };
const PIXELS = { hint: "More shows finer detail where the mill can cut it, and takes longer to compute." };
const BEAM = { hint: "Where a laser's beam has fallen to 1/e² of its middle." };
const BALL = { hint: "Valleys tighter than this are filled; 0: none." };
const AGAINST = { usual: [0, 0], hint: "The lens is made sharper by as much as the tool will blur." };

const OPTICS = [
  number("optics.refractive_index", "Refractive index", "", 1.49, INDEX),
  choice("optics.surface", "Surface", SURFACES, "lens"),
  choice("optics.viewed_from", "Looked at", VIEWS, "lens"),
  choice("optics.outline", "Outline", SHAPES, "rectangle"),
  number("optics.screen_height_mm", "Picture height", "mm", "in proportion"),
  number("optics.screen_shift_x_mm", "Picture moved right", "mm", 0),
  number("optics.screen_shift_y_mm", "Picture moved up", "mm", 0),
  number("optics.light.gaussian_mm", "Beam diameter", "mm", "even light", BEAM),
  choice("optics.method", "Method", METHODS, "transport"),
  choice("optics.branch", "Rays", BRANCHES, "auto"),
  whole("optics.corrections", "Corrections", 2, { hint: "Rounds against the lens's own light, 0 to 3." }),
  tick("optics.polish", "Polish the picture (slow)"),
  tick("optics.creases", "Leave creases sharp"),
  number("optics.min_radius_mm", "Smallest ball to fit", "mm", "of the finish", BALL),
  whole("optics.vertices_per_pixel", "Vertices per pixel", 2),
  numbers("optics.foreseen_blur_mm", "Blur to work against", "mm", ["across", "up"], AGAINST),
];

const STOCK = [
  number("stock.thickness_mm", "Thickness", "mm", 40),
  number("stock.margin_mm", "Margin around", "mm", 8),
  number("stock.skim_mm", "Skim off the top", "mm", 0.1),
  choice("stock.material", "Material", [["pmma", "acrylic (PMMA)"]], "pmma"),
];

const YES_NO = [[null, OF_MACHINE], [true, "yes"], [false, "no"]];
const COOLANTS = [[null, OF_MACHINE], ["none", "none"], ["air", "air"], ["mist", "mist"], ["flood", "flood"]];
const MODES = [[null, OF_MACHINE], ["none", "none"], ["g05.1", "G05.1"], ["g08", "G08"]];
const BLEND = { hint: "LinuxCNC only; 0: exact stop." };
const WARM_UP = { hint: "In the first program, in steps of speed." };

const MACHINE = [
  numbers("machine.travel_mm", "Travel", "mm", XYZ),
  numbers("machine.max_rate_mm_per_min", "Fastest", "mm/min", XYZ),
  numbers("machine.acceleration_mm_per_s2", "Acceleration", "mm/s²", XYZ),
  numbers("machine.spindle_rpm", "Spindle", "rpm", ["slowest", "fastest"]),
  number("machine.safe_z_mm", "Safe height", "mm", OF_MACHINE),
  number("machine.step_mm", "Smallest step", "mm", OF_MACHINE),
  number("machine.z_noise_mm", "Noise in Z", "mm", OF_MACHINE),
  choice("machine.whole_steps", "On whole steps", YES_NO, null),
  number("machine.junction_deviation_mm", "Junction deviation", "mm", OF_MACHINE),
  whole("machine.planner_blocks", "Blocks planned ahead", OF_MACHINE),
  number("machine.lines_per_s", "Lines per second", "", OF_MACHINE),
  number("machine.most_program_mb", "Largest program", "MB", "no limit"),
  number("machine.most_program_hours", "Longest program", "h", "no limit"),
  choice("machine.coolant", "Coolant or air", COOLANTS, null),
  number("machine.warm_up_s", "Spindle warm-up", "s", OF_MACHINE, WARM_UP),
  choice("machine.trace_outline", "Trace the block first", YES_NO, null),
  number("machine.blend_tolerance_mm", "Corners rounded by", "mm", OF_MACHINE, BLEND),
  choice("machine.high_precision", "High-precision mode", MODES, null),
];

/** [title, rows] of what is folded away. */
const WORK = { hint: "On the whole lens. Empty: planned with “Recommended”, else as the process takes." };
const LEVELS = { hint: "What is left of a wave of k rad/mm is exp(-(k / this)^order). The test piece measures yours." };
const TOOL_SIZE = { hint: "Of the pad or block: it follows whatever is longer." };

const FINISHING = [
  number("finish.minutes", "Work", "min", "planned", WORK),
  number("finish.k0_rad_per_mm", "Levels from", "rad/mm", "usual", LEVELS),
  number("finish.order", "Order", "", "usual", { hint: "1 soft pad, 2 sanding, 4 a film that levels." }),
  number("finish.depth_um", "Comes off", "µm", "usual"),
  number("finish.pad_mm", "Size of the tool", "mm", "usual", TOOL_SIZE),
];

export const EXPERT = [
  ["Picture", [whole("image.pixels", "Pixels across", 512, PIXELS)]],
  ["Optics", OPTICS],
  ["Stock", STOCK],
  ["Machine", MACHINE],
  ["Finish by hand", FINISHING],
];

/** The figures of one pass, in the order of its card. */
export const PASS = [
  { key: "name", label: "Name", kind: "text", usual: "finish" },
  number("radius_mm", "Ball radius", "mm", "needed"),
  number("pitch_mm", "Pitch", "mm", "needed"),
  number("stock_to_leave_mm", "Stock to leave", "mm", 0),
  choice("strategy", "Strategy", [["raster", "rows"], ["contour", "contour lines"]], "raster"),
  choice("direction", "Rows along", [["x", "X"], ["y", "Y"]], "x"),
  choice("link", "Between rows", [["u-turn", "turn"], ["retract", "lift"]], "u-turn"),
  choice("where", "Where", [["everywhere", "everywhere"], ["rest", "only the rest"]], "everywhere"),
  number("step_down_mm", "Step down", "mm", "usual"),
  number("feed_mm_per_min", "Feed", "mm/min", "usual"),
  number("plunge_mm_per_min", "Plunge", "mm/min", "usual"),
  number("spindle_rpm", "Spindle", "rpm", "usual"),
  number("flute_length_mm", "Flute length", "mm", "not checked"),
  number("shank_radius_mm", "Shank radius", "mm", "not checked"),
];
