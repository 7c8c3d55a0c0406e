/** Conclusions from the position: is the work zero known, is the tool in the block, how far may it go. Pure. */

const SMALL_MM = 0.0005; // half a digit of the readout
const CORNER_MM = 5; // most that homing pulls off
const EDGE_MM = 2; // distance that a long step keeps from the end of travel
const LONG_MM = 20;
const AXES = "XYZ";

/** Whether the work zero of these axes was set: by a person here, or before, so that it differs from the machine's own. */
export function isZeroKnown({ mill }, axes) {
  if (!isPlaced(mill)) return false;
  const set = (k) => mill.zeroed?.includes(AXES[k]) || Math.abs(mill.machine_mm[k] - mill.work_mm[k]) > SMALL_MM;
  return Boolean(mill.position_trusted) && [...axes].every((axis) => set(AXES.indexOf(axis)));
}

/**
 * Axes whose zero belongs to an earlier block: it was set before the last program began, and this program does not follow that one.
 * before: the run of that program, null if there is none.
 */
export function findForeignAxes({ mill }, run, before) {
  const follows = before?.job === run.job && (before.state !== "finished" || before.program.number < run.program.number);
  return before && !follows ? [...AXES].filter((axis) => !mill.zeroed_anew?.includes(axis)).join("") : "";
}

/** Whether X, Y and Z are set for this program; true if that is not known. */
export function isZeroSet(machine, run, before) {
  if (!isPlaced(machine.mill)) return true;
  return isZeroKnown(machine, AXES) && !findForeignAxes(machine, run, before);
}

/** If the link reports no position, the person is responsible for zero and height. */
export function isPlaced(mill) {
  return [mill?.machine_mm, mill?.work_mm].every((place) => place?.length === 3 && place.every(Number.isFinite));
}

/** How deep the tip is below the top of the block, mm; 0 if it is above it, or if that is not known. */
export function depthInBlock(machine) {
  const { mill } = machine ?? {};
  if (mill?.state !== "idle" || mill.needs?.length || !isZeroKnown(machine, "Z")) return 0;
  return mill.work_mm[2] < -SMALL_MM ? -mill.work_mm[2] : 0;
}

/** How far Z has to rise to the height at which the tool travels, mm; limited by the machine's travel. */
export function riseToSafe({ mill, profile }) {
  const wanted = (profile?.safe_z_mm ?? 5) - mill.work_mm[2];
  const room = mill.machine_mm[2] <= 0 ? -mill.machine_mm[2] - 0.5 : wanted;
  return Math.max(0, Math.min(wanted, room));
}

/** How much higher than its zero a program may run, with its rapids above that, mm; Infinity if that is not known. */
export function roomToLift({ mill, profile }) {
  if (!profile?.homing || !isZeroKnown({ mill }, "Z") || mill.machine_mm[2] > 0) return Infinity;
  return mill.work_mm[2] - mill.machine_mm[2] - (profile.safe_z_mm ?? 5);
}

/** Whether an axis is where homing leaves it, so that no one has moved the tool yet. */
export function isAtHome({ mill, profile }, axes) {
  const travel = profile?.travel_mm;
  if (!profile?.homing || !travel || !isPlaced(mill)) return false;
  const ends = (k) => Math.min(Math.abs(mill.machine_mm[k]), Math.abs(mill.machine_mm[k] + travel[k]));
  return [...axes].every((axis) => ends(AXES.indexOf(axis)) < CORNER_MM);
}

/**
 * A step as far as the machine goes. Machine coordinates run from -travel to 0 after homing; where they do not, or the
 * mill was never homed, only the controller knows. A short step is never changed.
 */
export function withinTravel({ mill, profile }, by_mm) {
  const travel = profile?.homing && mill?.position_trusted && isPlaced(mill) ? profile.travel_mm : null;
  const inside = (k) => mill.machine_mm[k] <= 0 && mill.machine_mm[k] >= -travel[k];
  return by_mm.map((by, k) => {
    if (!travel || Math.abs(by) <= LONG_MM || !inside(k)) return by;
    const room = by > 0 ? -EDGE_MM - mill.machine_mm[k] : travel[k] - EDGE_MM + mill.machine_mm[k];
    return Math.sign(by) * Math.min(Math.abs(by), Math.max(0, room));
  });
}
