"""The check reads a written program back and simulates the cut; its verdict decides whether the program may be used.

Nothing of the generator is used here: text -> moves (cam.reading) -> stock left (`removal`) on the whole part and in
fine windows, contact with the exact surface move by move (`clearance`), track spacing (`path_quality`),
time (cam.duration), the rules for single moves (`move_rules`), the bite (`engagement`) and, where flutes and shank are
stated, stock and clamps beside them (`collision`).
Two threads share each batch of moves while the next one is parsed; memory does not grow with the program, except for
the tracks of a contour pass, 9 bytes a move (`path_quality`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from itertools import chain

import numpy as np

from cam.checking.chips import Chips, ChipTime
from cam.checking.clearance import Overlaps, witness_of
from cam.checking.collision import Clamps, Collisions, shank_of
from cam.checking.engagement import Engagement
from cam.checking.flat_removal import removal_of
from cam.checking.move_rules import MoveRules
from cam.checking.path_quality import Coverage, PathMeasures, PathQuality
from cam.checking.removal import Drops, Window, deepest, place_windows
from cam.duration import DurationModel, Kinematics
from cam.passes import PassSpec, Stock
from cam.reading.gcode import GRBL, Language, MoveBatch, read_parts
from cam.rows.rest import RestAreas
from cam.surface.stock_grid import StockGrid
from cam.surface.stock_left import ExcessFound, StockLeft, Unreached, find_excess
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

GOUGE_ALLOWED_UM = 1.0
GAP_ALLOWED_PITCHES = 1.5
"""One row left out makes a gap of two."""

CONTOUR_GAP_PITCHES, ROUNDING_MM = 1.02, 1.5e-4
"""For contour passes, which are scanned everywhere: rounding may have moved either track by half a digit of x and of y.
"""

SHARES = 2
RAPID_CLEARANCE_MM = 0.5
"""A rapid may go straight down below the safe height where the stock, as simulated so far, stays this far away."""

UNCUT_ALLOWED_MM = 0.005
"""Above the cusps, where the ball reaches: its fit is only sampled, to within a few micrometres."""
SEEN_SHARE, SEEN_UM = 1e-3, 20.0
"""Share of the aperture and height above it: unreached spots that are smaller and lower are not reported."""

SCAN_SHARE = 0.15  # of a contour pass's check: the scan for gaps at its end
Progress = Callable[[float], None]
Bounds = dict[str, list[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class WindowResult:
    """A fine window after the pass: stock above the lens and the stock to leave [µm], measured along Z."""

    name: str
    x_mm: float
    y_mm: float
    size_mm: float
    cell_um: float
    lowest_um: float
    mean_um: float
    rms_um: float
    highest_um: float
    cusp_theory_um: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PassCheck:
    """What one program does to the stock. `faults` are sentences; a program without any is `ok`.

    excess_um        : greatest stock above the wanted surface within the ball's reach, regular cusps included
    excess_ratio     : that, over the height that pitch, slope and curvature explain there (99.9 % of cells stay below)
    climb_share      : share of the volume that was cut climbing; slot_length_mm of the path cut at full width,
                       slot_depth_mm deep at most; flute_need_mm how high above the tip stock was cut
    below_leave_um   : how far the pass cut into the stock it should leave
    unreached        : the highest spots the ball cannot touch; unreached_share of the aperture's area
    contour          : of a contour pass, how it runs (`cam.checking.path_quality`)
    rest             : of a rest pass, where it cuts: area_mm2, regions
    starved_s        : of time_s, how long the mill stands because lines come too slowly
    chips            : how long it cuts with chips below, within and above the band of the material
    cut_bounds       : like bounds, without moves in the air: a trace around the block is wider than any cut
    stock_top        : what is left, for the next pass
    """

    faults: tuple[Phrase, ...]
    notes: tuple[Phrase, ...]
    lines: int
    bytes: int
    moves: int
    path_length_mm: float
    time_s: float
    starved_s: float
    entries: int
    max_engagement_mm: float
    climb_share: float
    slot_length_mm: float
    slot_depth_mm: float
    flute_need_mm: float
    gouge_um: float
    excess_um: float
    excess_ratio: float
    below_leave_um: float
    max_gap_mm: float
    bounds: Bounds
    unreached: tuple[Unreached, ...]
    unreached_share: float
    windows: tuple[WindowResult, ...]
    stock_top: StockGrid
    contour: PathMeasures | None = None
    rest: RestAreas | None = None
    cut_bounds: Bounds | None = None
    chips: ChipTime | None = None

    @property
    def ok(self) -> bool:
        return not self.faults

    def as_report(self) -> dict[str, object]:
        """Return plain values for report.json; the file's name and hash are the caller's."""
        return {
            "ok": self.ok,
            "faults": list(self.faults),
            "notes": list(self.notes),
            **{
                name: getattr(self, name)
                for name in (
                    *("lines", "bytes", "moves", "path_length_mm", "time_s", "starved_s", "entries"),
                    *("max_engagement_mm", "climb_share", "slot_length_mm", "slot_depth_mm", "flute_need_mm"),
                    *("gouge_um", "excess_um", "excess_ratio", "below_leave_um", "max_gap_mm", "bounds"),
                    "unreached_share",
                )
            },
            "unreached": [asdict(place) for place in self.unreached],
            "windows": [asdict(window) for window in self.windows],
            **({} if self.chips is None else {"chips": {**asdict(self.chips), "share": self.chips.share}}),
            **({} if self.cut_bounds is None else {"cut_bounds": self.cut_bounds}),
            **({} if self.contour is None else {"contour": self.contour.as_report()}),
            **({} if self.rest is None else {"rest": self.rest.as_report()}),
        }


def check_program(
    chunks: Iterable[bytes],
    *,
    heightfield: Heightfield,
    spec: PassSpec,
    stock: Stock,
    stock_top: StockGrid,
    kinematics: Kinematics,
    safe_z_mm: float,
    language: Language = GRBL,
    digit_mm: float = 0.0,
    further: Iterable[Iterable[bytes]] = (),
    total_bytes: int | None = None,
    on_progress: Progress | None = None,
) -> PassCheck:
    """Cut the program into stock_top and judge it. Raises ProgramError if the text itself is not allowed.

    digit_mm    : digit of heights, by the language or by the mill; where it is coarse, larger deviations are allowed
    further     : programs that go on where this one ends, when a pass is split
    total_bytes : length of the program if known; then on_progress gets the share done
    """
    run = _Run(heightfield, spec, stock, stock_top, kinematics, safe_z_mm, digit_mm)
    report = on_progress or (lambda share: None)
    cutting = 1.0 if run.quality is None else 1.0 - SCAN_SHARE
    with ThreadPoolExecutor(max_workers=SHARES) as pool:
        waiting: _Pending | None = None
        for batch in read_parts(chain([chunks], further), language):
            if waiting is not None:
                run.finish(waiting)
            waiting = run.begin(batch, pool)
            if total_bytes:
                report(cutting * min(1.0, batch.bytes_read / total_bytes))
        if waiting is not None:
            run.finish(waiting)
    return run.verdict(lambda share: report(cutting + (1.0 - cutting) * share))


class _Pending:
    """A batch that is being processed."""

    def __init__(self, batch: MoveBatch, run: _Run, pool: ThreadPoolExecutor) -> None:
        self.batch = batch
        self.overlaps = pool.submit(run.watch, batch)
        self.drops = [pool.submit(run.whole.sweep, batch, share) for share in range(run.whole.shares)]
        self.done = pool.submit(run.duration.add_batch, batch)
        self.windows = pool.submit(run.cut_windows, batch)


class _Run:
    """The state of one check."""

    def __init__(
        self,
        heightfield: Heightfield,
        spec: PassSpec,
        stock: Stock,
        before: StockGrid,
        kinematics: Kinematics,
        safe_z_mm: float,
        digit_mm: float,
    ) -> None:
        self.digit_mm = digit_mm
        self.heightfield, self.spec, self.stock, self.before = heightfield, spec, stock, before
        self.whole = removal_of(
            spec.shape,
            before,
            radius_mm=spec.radius_mm,
            rapid_clearance_mm=RAPID_CLEARANCE_MM,
            shares=SHARES,
            shank=shank_of(spec),
        )
        self.engagement, self.collisions = Engagement(spec, cell_mm=before.cell_mm), Collisions(spec)
        self.clamps = Clamps(stock.clamps, radius_mm=spec.radius_mm, shank_radius_mm=spec.shank_radius_mm)
        self.rest = RestAreas.of(before, heightfield, spec) if spec.where == "rest" else None
        self.places = place_windows(heightfield, spec, before)
        self.windows = [removal_of(spec.shape, place.stock, radius_mm=spec.radius_mm) for place in self.places]
        # A track counts as part of the surface if it is no farther above it than this; higher layers do not count.
        self._near_mm = 1.5 * spec.stock_to_leave_mm + min(0.1, 0.2 * spec.radius_mm)
        if not spec.is_ball:  # it stays farther from a slope, and its rim touches between the sampled points
            self._near_mm = max(self._near_mm * float(np.hypot(1.0, heightfield.steepest)), spec.step_down_mm / 2)
        self.witness = witness_of(heightfield, spec, near_mm=self._near_mm)
        self.coverage = Coverage(before, pitch_mm=spec.pitch_mm)
        self.quality = PathQuality(heightfield, spec) if spec.strategy == "contour" else None
        self.duration, self.chips = DurationModel(kinematics), Chips(spec)
        self.rules = MoveRules(
            heightfield,
            spec,
            stock,
            highest_mm=float(before.top_mm.max()),
            safe_z_mm=safe_z_mm,
            rapid_clearance_mm=RAPID_CLEARANCE_MM,
            gouge_allowed_um=max(GOUGE_ALLOWED_UM, 1500 * digit_mm),
        )

    def begin(self, batch: MoveBatch, pool: ThreadPoolExecutor) -> _Pending:
        self.whole.refresh()
        return _Pending(batch, self, pool)

    def watch(self, batch: MoveBatch) -> Overlaps:
        overlaps = self.witness.overlaps(batch)
        if self.quality is None:
            self.coverage.add(batch, overlaps.touch_mm > -self._near_mm)
        else:
            self.quality.add(batch, overlaps)
        return overlaps

    def cut_windows(self, batch: MoveBatch) -> None:
        for window in self.windows:
            window.cut(batch)

    def finish(self, pending: _Pending) -> None:
        drops = deepest([share.result() for share in pending.drops])
        self.whole.finish_batch(pending.batch)
        self.rules.judge(pending.batch, drops, pending.overlaps.result(), self.whole)
        self.engagement.add(pending.batch, drops)
        self.collisions.add(pending.batch, drops, self.whole)
        self.clamps.add(pending.batch)
        self.chips.add(pending.batch, drops, pending.done.result())
        pending.windows.result()

    def verdict(self, report: Progress) -> PassCheck:
        depth, cell = self.whole.cut_at_rest()
        if self.rest is not None and not self.rest.core.any():
            self.rules.notes.append(Phrase("the ball before has left nothing to this one: the program only lifts"))
        self.rules.judge_rest(Drops(depth_mm=np.array([depth]), cell=np.array([cell])), self.whole)
        for window in self.windows:
            window.cut_at_rest()
        after = self.whole.stock()
        left = StockLeft.of(after, self.heightfield, self.spec)
        fine = [StockLeft.of(window.stock(), self.heightfield, self.spec) for window in self.windows]
        excess = find_excess(left, self.heightfield, self.spec, None if self.rest is None else self.rest.core)
        gouge_um = self._gouge_um(left, fine)
        measures = None if self.quality is None else self.quality.measure(report)
        gap_mm = self._row_gap(left) if measures is None else self._contour_gap(measures)
        self._judge_excess(excess)
        rules = self.rules
        for sentence in (*self.collisions.faults, *self.clamps.faults, *self.engagement.faults):
            rules.add_fault(sentence)
        regular = left.in_aperture & ~left.suspicious(self.spec)
        ratio = left.over_mm[regular] / left.cusp_mm[regular]
        return PassCheck(
            faults=tuple(rules.faults),
            notes=tuple(rules.notes),
            lines=rules.lines,
            bytes=rules.bytes,
            moves=rules.moves,
            path_length_mm=rules.path_length_mm,
            time_s=self.duration.seconds,
            starved_s=self.duration.starved_s,
            entries=rules.entries,
            max_engagement_mm=rules.max_engagement_mm,
            climb_share=self.engagement.climb_share,
            slot_length_mm=self.engagement.slot_length_mm,
            slot_depth_mm=self.engagement.slot_depth_mm,
            flute_need_mm=self.engagement.flute_need_mm,
            gouge_um=gouge_um,
            excess_um=excess.excess_um,
            excess_ratio=float(np.quantile(ratio, 0.999)) if ratio.size else 0.0,
            below_leave_um=self._below_leave_um(left, fine),
            max_gap_mm=gap_mm,
            bounds=rules.bounds,
            unreached=excess.unreached,
            unreached_share=excess.unreached_share,
            windows=tuple(_window_result(p, f) for p, f in zip(self.places, fine, strict=True)),
            stock_top=after,
            contour=measures,
            rest=self.rest,
            chips=self.chips.finish(self.duration.list_waiting_s()),
            cut_bounds=None if _as_wide(rules.cut_bounds, rules.bounds) else rules.cut_bounds,
        )

    def _gouge_um(self, left: StockLeft, fine: list[StockLeft]) -> float:
        """Return the deepest cut below the lens: by contact, by the whole part's cells, and by the windows' cells."""
        deepest_mm = self.rules.gouge_mm
        for grid, result in [(self.whole, left), *zip(self.windows, fine, strict=True)]:
            touched = grid.cut_by_line > 0
            over_mm, cell = result.lowest_over_lens(touched)
            if cell >= 0:
                self.rules.note_gouge(-over_mm, int(grid.cut_by_line.flat[cell]), grid.place_mm(cell))
                deepest_mm = max(deepest_mm, -over_mm)
        return 1000 * max(0.0, deepest_mm)

    def _below_leave_um(self, left: StockLeft, fine: list[StockLeft]) -> float:
        pairs = [(self.whole, left), *zip(self.windows, fine, strict=True)]
        lowest_mm = min(result.lowest(grid.cut_by_line > 0)[0] for grid, result in pairs)
        return 1000 * max(0.0, -lowest_mm)

    def _row_gap(self, left: StockLeft) -> float:
        """Return the widest gap between rows where there was stock to take off; note a fault when a row is missing."""
        start = StockLeft.of(self.before, self.heightfield, self.spec)
        with np.errstate(invalid="ignore"):
            wanted = start.over_mm > 2 * left.cusp_mm + (0.001 if self.spec.is_ball else self._near_mm)
        if self.rest is not None:
            wanted &= self.rest.core
        gap_mm, x_mm, y_mm = self.coverage.widest_gap_mm(wanted)
        self._judge_gap(gap_mm, x_mm, y_mm, allowed_mm=GAP_ALLOWED_PITCHES * self.spec.pitch_mm)
        return gap_mm

    def _contour_gap(self, measures: PathMeasures) -> float:
        """Return the widest gap between the tracks of a contour pass, on the whole aperture."""
        gap = measures.gap
        allowed_mm = CONTOUR_GAP_PITCHES * self.spec.pitch_mm + max(ROUNDING_MM, 1.5 * self.digit_mm)
        self._judge_gap(gap.width_mm, gap.x_mm, gap.y_mm, allowed_mm=allowed_mm)
        return gap.width_mm

    def _judge_gap(self, gap_mm: float, x_mm: float, y_mm: float, *, allowed_mm: float) -> None:
        if gap_mm > allowed_mm:
            self.rules.add_fault(
                Phrase(
                    "tracks are {gap_mm:.4g} mm apart at X{x_mm:.3f} Y{y_mm:.3f} (allowed {allowed_mm:.4g} mm)",
                    gap_mm=gap_mm,
                    x_mm=x_mm,
                    y_mm=y_mm,
                    allowed_mm=allowed_mm,
                )
            )

    def _judge_excess(self, excess: ExcessFound) -> None:
        allowed_mm = UNCUT_ALLOWED_MM + 0.25 * self.spec.stock_to_leave_mm + 1.5 * self.digit_mm
        if excess.uncut_mm > allowed_mm:
            self.rules.add_fault(
                Phrase(
                    "{left_um:.1f} µm more than the cusps are left at X{x_mm:.3f} Y{y_mm:.3f} where the ball could "
                    "reach (allowed {allowed_um:.1f} µm)",
                    left_um=1000 * excess.uncut_mm,
                    x_mm=excess.x_mm,
                    y_mm=excess.y_mm,
                    allowed_um=1000 * allowed_mm,
                )
            )
        if excess.unreached and (excess.unreached_share > SEEN_SHARE or excess.unreached[0].excess_um > SEEN_UM):
            highest, share = excess.unreached[0], excess.unreached_share
            place = Phrase(
                "it leaves {excess_um:.0f} µm on {area_mm2:.2g} mm² at X{x_mm:.2f} Y{y_mm:.2f}",
                excess_um=highest.excess_um,
                area_mm2=highest.area_mm2,
                x_mm=highest.x_mm,
                y_mm=highest.y_mm,
            )
            self.rules.notes.append(
                Phrase(
                    "the ball of radius {radius_mm:g} mm cannot reach {percent:.2g} % of the lens; highest: {place}",
                    radius_mm=self.spec.radius_mm,
                    percent=100 * share,
                    place=place,
                )
                if share > SEEN_SHARE  # smaller shares would be shown as 0
                else Phrase(
                    "the ball of radius {radius_mm:g} mm does not reach into every crease: {place}",
                    radius_mm=self.spec.radius_mm,
                    place=place,
                )
            )


def _as_wide(some: Bounds, others: Bounds) -> bool:
    return all(some[axis] == others[axis] for axis in "xy")


def _window_result(place: Window, left: StockLeft) -> WindowResult:
    over_um = 1000 * left.over_mm[left.in_aperture]
    grid = left.grid
    size_mm = grid.top_mm.shape[0] * grid.cell_mm
    return WindowResult(
        name=place.name,
        x_mm=grid.x0_mm + size_mm / 2,
        y_mm=grid.y0_mm + size_mm / 2,
        size_mm=size_mm,
        cell_um=1000 * grid.cell_mm,
        lowest_um=float(over_um.min()),
        mean_um=float(over_um.mean()),
        rms_um=float(np.sqrt(np.mean(over_um**2))),
        highest_um=float(over_um.max()),
        cusp_theory_um=1000 * float(np.nanmax(left.cusp_mm)),
    )
