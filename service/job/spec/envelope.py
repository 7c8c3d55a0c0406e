"""Whether a job fits its mill: travel, table, head and clamps; one rule for a submitted job, an estimate, the command
line and a plan.

Width, height and the block are checked as soon as a job is resolved; the rest when the lens has been computed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from math import ceil, floor, inf

from cam.around.specs import BESIDE_MM
from cam.checking.envelope import ABOVE_CLAMPS_MM, CLAMP_GRIP_MM, NOSE_CLEARANCE_MM, USUAL_NOSE_MM, Envelope, Reach
from cam.passes import Clamp
from machines.profile import MachineProfile
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.cutting import CLAMPS
from service.job.spec.model import JobSpec

Problem = tuple[str, Phrase]
_ROUNDING_MM = 1e-6
_CLAMP_BESIDE_MM = 40.0  # how far a clamp of a usual set goes beyond the block, with its bolt and its support


def require_envelope(
    spec: JobSpec,
    machine: MachineProfile,
    *,
    depth_mm: float,
    lowest_mm: Sequence[float] | None = None,
    witness: Reach | None = None,
) -> None:
    """Raise SpecError if the programs of a job need more than the mill has. depth_mm : of the lens; lowest_mm : of each
    pass's tip, with its run-out; None: not known better; witness: of the marks' program, once they have a place
    """
    radii = [row.radius_mm for row in spec.passes]
    reaches = list_reaches(spec, depth_mm=depth_mm, lowest_mm=lowest_mm)
    if witness is not None:
        reaches["finish.witness"] = witness
    problems = [*find_beyond_travel(spec, machine, radii, depth_mm=depth_mm), *find_misfits(spec, machine, reaches)]
    raise_problems(problems)


def raise_problems(found: Sequence[tuple[Problem, float | None]]) -> None:
    """Raise SpecError for these problems, if there are any, with the values that would fit."""
    if found:
        raise SpecError([one for one, _ in found], {key: use for (key, _), use in found if use is not None})


def list_clamps(spec: JobSpec) -> tuple[Clamp, ...]:
    """Return the clamps of a job: those listed, and those named, anywhere along the block's left and right sides."""
    stock, optics = spec.stock, spec.optics
    listed = tuple(Clamp(**clamp.model_dump()) for clamp in stock.clamps or ())
    if stock.clamping == "none":
        return listed
    wide_mm = CLAMP_GRIP_MM + _CLAMP_BESIDE_MM
    ends = (-stock.margin_mm - _CLAMP_BESIDE_MM, optics.width_mm + stock.margin_mm - CLAMP_GRIP_MM)
    return listed + tuple(
        Clamp(
            x_mm=x_mm,
            y_mm=-stock.margin_mm,
            width_mm=wide_mm,
            depth_mm=optics.height_mm + 2 * stock.margin_mm,
            height_mm=CLAMPS[stock.clamping].height_mm,
        )
        for x_mm in ends
    )


def safe_z_over_clamps_mm(spec: JobSpec, safe_z_mm: float) -> float:
    """Return the height of rapids: the mill's usual one, or a height that clears the job's clamps."""
    highest_mm = max((clamp.height_mm for clamp in list_clamps(spec)), default=0.0)
    return max(safe_z_mm, highest_mm + ABOVE_CLAMPS_MM) if highest_mm > 0 else safe_z_mm


def envelope_of(spec: JobSpec, machine: MachineProfile) -> Envelope:
    """Return the job's block on its mill."""
    stock, optics = spec.stock, spec.optics
    return Envelope(
        width_mm=optics.width_mm,
        height_mm=optics.height_mm,
        margin_mm=stock.margin_mm,
        thickness_mm=stock.thickness_mm,
        top_mm=0.0 if stock.face is None else stock.face.above_mm,
        through_mm=0.0 if stock.cut_out is None else stock.cut_out.through_mm,
        clamps=list_clamps(spec),
        base_mm=stock.base_mm,
        safe_z_mm=machine.safe_z_mm,
        travel_z_mm=machine.travel_mm[2],
        bed_to_collet_mm=machine.bed_to_collet_mm,
        gantry_mm=machine.gantry_mm,
        nose_mm=machine.nose_mm or USUAL_NOSE_MM,
    )


def list_reaches(spec: JobSpec, *, depth_mm: float, lowest_mm: Sequence[float] | None = None) -> dict[str, Reach]:
    """Return where each program takes its tool, by its key in the spec; see `require_envelope`."""
    stock, found = spec.stock, dict[str, Reach]()
    if (face := stock.face) is not None:
        beyond_mm = stock.margin_mm + face.radius_mm + BESIDE_MM
        found["stock.face"] = Reach(
            radius_mm=face.radius_mm,
            shank_radius_mm=face.shank_radius_mm,
            beyond_mm=(beyond_mm, stock.margin_mm),
            lowest_mm=0.0,
        )
    for number, row in enumerate(spec.passes):
        found[f"passes.{number}"] = Reach(
            radius_mm=row.radius_mm,
            shank_radius_mm=row.shank_radius_mm,
            beyond_mm=(row.radius_mm, row.radius_mm),
            lowest_mm=-max(depth_mm, stock.skim_mm) if lowest_mm is None else min(lowest_mm[number], 0.0),
            stick_out_mm=row.stick_out_mm,
            flute_length_mm=row.flute_length_mm,
        )
    if (cut_out := stock.cut_out) is not None:
        found["stock.cut_out"] = Reach(
            radius_mm=cut_out.radius_mm,
            shank_radius_mm=cut_out.shank_radius_mm,
            beyond_mm=(cut_out.radius_mm, cut_out.radius_mm),
            lowest_mm=-stock.thickness_mm - cut_out.through_mm,
            flute_length_mm=cut_out.flute_length_mm,
        )
    return found


def reach_of_witness(spec: JobSpec, box_mm: tuple[float, float, float, float], lowest_mm: float) -> Reach:
    """Return where the program of the witness marks takes the tool of the last pass: over their strip (left, right,
    front, back).
    """
    tool = list_reaches(spec, depth_mm=0.0)[f"passes.{len(spec.passes) - 1}"]
    return replace(tool, beyond_mm=(0.0, 0.0), strip_mm=box_mm, lowest_mm=lowest_mm)


def find_misfits(
    spec: JobSpec, machine: MachineProfile, reaches: Mapping[str, Reach]
) -> Iterator[tuple[Problem, float | None]]:
    """Yield what does not fit between table and head, as `find_beyond_travel` does."""
    envelope = envelope_of(spec, machine)
    yield from _find_off_table(spec, machine)
    yield from _find_low_rapids(envelope, machine)
    for key, reach in reaches.items():
        yield from _find_struck(spec, envelope, key, reach)
        need_mm = envelope.least_stick_out_mm(reach)
        if reach.stick_out_mm is not None and reach.stick_out_mm < need_mm - _ROUNDING_MM:
            words = Phrase(
                "{have_mm:g} is too short: at Z{lowest_mm:.4g} the collet would be less than {clear_mm:g} mm above the "
                "block, a clamp or the flutes; allowed: at least {need_mm:.4g}",
                have_mm=reach.stick_out_mm,
                lowest_mm=reach.lowest_mm,
                clear_mm=NOSE_CLEARANCE_MM,
                need_mm=_round_up(need_mm),
            )
            yield (f"{key}.stick_out_mm", words), _round_up(need_mm)
    yield from _find_short_flutes(spec)
    yield from _find_too_tall(spec, machine, envelope, reaches)


def _find_short_flutes(spec: JobSpec) -> Iterator[tuple[Problem, float | None]]:
    """Find a cutter whose shank would rub in the slot around the lens."""
    cut_out, thick_mm = spec.stock.cut_out, spec.stock.thickness_mm
    if cut_out is None or cut_out.flute_length_mm is None:
        return
    need_mm, is_necked = thick_mm + cut_out.through_mm, (cut_out.shank_radius_mm or inf) < cut_out.radius_mm
    if cut_out.flute_length_mm < need_mm and not is_necked:
        words = Phrase(
            "{have_mm:g} is less than the slot is deep, {need_mm:g} mm, and the shank would rub in it; allowed: at "
            "least that, or a shank thinner than the cutter (shank_radius_mm)",
            have_mm=cut_out.flute_length_mm,
            need_mm=need_mm,
        )
        yield ("stock.cut_out.flute_length_mm", words), need_mm


def find_unstated(machine: MachineProfile) -> Iterator[Problem]:
    """Yield the figures that programs depend on and that only the owner of the mill knows."""
    if "top_z_mm" in machine.guesses:
        yield (
            "machine.top_z_mm",
            Phrase(
                "{value:g} is a guess, and every program for {machine} would begin by going there: too high is an "
                "alarm, too low goes down first. Look up machine Z of your raised head and give it, in the job or in a "
                'profile of your own that extends "{machine}": top_z_mm = ...',
                value=machine.top_z_mm,
                machine=machine.name,
            ),
        )


def _find_off_table(spec: JobSpec, machine: MachineProfile) -> Iterator[tuple[Problem, float | None]]:
    """Find a block that is larger than the table."""
    margin_mm = spec.stock.margin_mm
    sides = (("optics.width_mm", "X", spec.optics.width_mm), ("optics.height_mm", "Y", spec.optics.height_mm))
    for number, (key, axis, side_mm) in enumerate(sides if machine.table_mm is not None else ()):
        assert machine.table_mm is not None
        have_mm, block_mm = machine.table_mm[number], side_mm + 2 * margin_mm
        if block_mm <= have_mm + _ROUNDING_MM:
            continue
        most_mm = floor(have_mm - 2 * margin_mm)
        words = Phrase(
            "the block is {block_mm:.6g} mm along {axis}, a lens of {side_mm:g} mm with {margin_mm:g} mm of margin on "
            "either side (stock.margin_mm); the table of {machine} is {table_mm:g} mm (machine.table_mm.{number})",
            block_mm=block_mm,
            axis=axis,
            side_mm=side_mm,
            margin_mm=margin_mm,
            machine=machine.name,
            table_mm=have_mm,
            number=number,
        )
        yield _offer(key, words, most_mm)


def _find_low_rapids(envelope: Envelope, machine: MachineProfile) -> Iterator[tuple[Problem, float | None]]:
    need_mm = max((clamp.height_mm for clamp in envelope.clamps), default=-inf) + ABOVE_CLAMPS_MM
    if machine.safe_z_mm < need_mm - _ROUNDING_MM:
        words = Phrase(
            "{safe_z_mm:g} is lower than the clamps, and rapids cross them; allowed: at least {need_mm:g}, or left out",
            safe_z_mm=machine.safe_z_mm,
            need_mm=need_mm,
        )
        yield ("machine.safe_z_mm", words), need_mm


def _find_struck(spec: JobSpec, envelope: Envelope, key: str, reach: Reach) -> Iterator[tuple[Problem, float | None]]:
    """Find clamps that a cutter would come too near to. The way around the lens is checked where it is known, move by
    move.
    """
    if key == "stock.cut_out" and spec.stock.clamping == "none":
        return
    listed = len(spec.stock.clamps or ())
    for number, away_mm in envelope.find_struck(reach):
        need_mm = reach.widest_mm + ABOVE_CLAMPS_MM
        words = Phrase(
            "the axis of {key} comes within {away_mm:.4g} mm of the clamp (allowed: {need_mm:g} mm, a cutter of "
            "radius {radius_mm:g} mm and {clear_mm:g} mm of air)",
            key=key,
            away_mm=away_mm,
            need_mm=need_mm,
            radius_mm=reach.widest_mm,
            clear_mm=ABOVE_CLAMPS_MM,
        )
        if number < listed:
            yield (f"stock.clamps.{number}", Phrase("{problem}: move it outward", problem=words)), None
            continue
        if key == "stock.face":
            words = Phrase("facing goes over the whole top, and these clamps stand on it; allowed: held from below")
            yield ("stock.clamping", words), None
            return
        least_mm = spec.stock.margin_mm + need_mm - away_mm
        words = Phrase("{problem}; allowed: a margin of at least {least_mm:.4g}", problem=words, least_mm=least_mm)
        yield ("stock.margin_mm", words), least_mm
        return


def _find_too_tall(
    spec: JobSpec, machine: MachineProfile, envelope: Envelope, reaches: Mapping[str, Reach]
) -> Iterator[tuple[Problem, float | None]]:
    """Find a block that does not fit under the head with its tools, or that the tools do not reach."""
    least_mm, most_mm = envelope.base_range_mm(reaches.values())
    base_mm, thick_mm = envelope.base_mm, envelope.thickness_mm
    stands_mm = max(least_mm, 0.0) if base_mm is None else base_mm
    if stands_mm > most_mm + _ROUNDING_MM:
        longest_mm = max((envelope.stick_out_mm(reach) for reach in reaches.values()), default=0.0)
        under_gantry_mm = envelope.highest_mm + ABOVE_CLAMPS_MM
        by_gantry = most_mm == (machine.gantry_mm or inf) - thick_mm - under_gantry_mm
        words = Phrase(
            "a block of {thickness_mm:g} mm on a base of {base_mm:.4g} mm (stock.base_mm), rapids at Z{safe_z_mm:g} "
            "and a tool that sticks out {stick_out_mm:.4g} mm need {need_mm:.4g} mm over the table; the collet of "
            "{machine} goes up to {have_mm:g} mm (machine.bed_to_collet_mm{guessed})",
            thickness_mm=thick_mm,
            base_mm=stands_mm,
            safe_z_mm=machine.safe_z_mm,
            stick_out_mm=longest_mm,
            need_mm=thick_mm + stands_mm + machine.safe_z_mm + longest_mm,
            machine=machine.name,
            have_mm=machine.bed_to_collet_mm,
            guessed=Phrase(", a guess: measure yours") if "bed_to_collet_mm" in machine.guesses else "",
        )
        if by_gantry:
            words = Phrase(
                "a block of {thickness_mm:g} mm on a base of {base_mm:.4g} mm (stock.base_mm) and what stands on it "
                "need {need_mm:.4g} mm; under the gantry of {machine} there are {have_mm:g} mm (machine.gantry_mm)",
                thickness_mm=thick_mm,
                base_mm=stands_mm,
                need_mm=thick_mm + stands_mm + under_gantry_mm,
                machine=machine.name,
                have_mm=machine.gantry_mm,
            )
        key, fits_mm = "stock.base_mm", most_mm
        if base_mm is None or most_mm < 0:
            # the stick-out of a cutter that cuts the lens out grows with the thickness of the block
            share = 0.5 if "stock.cut_out" in reaches and not by_gantry else 1.0
            key, fits_mm = "stock.thickness_mm", thick_mm - share * (stands_mm - most_mm)
        fits_mm = floor(10 * fits_mm + _ROUNDING_MM) / 10
        yield _offer(key, words, fits_mm)
    elif stands_mm < least_mm - _ROUNDING_MM:
        words = Phrase(
            "{base_mm:g} is too low: the collet of {machine} comes down to {low_mm:g} mm over the table, or the lens "
            "is cut out through the block into it; allowed: at least {least_mm:.4g}",
            base_mm=stands_mm,
            machine=machine.name,
            low_mm=(machine.bed_to_collet_mm or 0.0) - machine.travel_mm[2],
            least_mm=_round_up(least_mm),
        )
        yield ("stock.base_mm", words), _round_up(least_mm)


def _offer(key: str, words: Phrase, most_mm: float) -> tuple[Problem, float | None]:
    """Return the problem with the greatest value of its key that would fit, if there is one."""
    if most_mm <= 0:
        return (key, words), None
    return (
        key,
        Phrase("{problem}; allowed: at most {most_mm:g} mm on this mill", problem=words, most_mm=most_mm),
    ), most_mm


def _round_up(value_mm: float) -> float:
    return ceil(10 * value_mm - _ROUNDING_MM) / 10


def find_beyond_travel(
    spec: JobSpec, machine: MachineProfile, radii_mm: Sequence[float], *, depth_mm: float = 0.0
) -> Iterator[tuple[Problem, float | None]]:
    """Yield each axis of the mill that is too short: key, sentence, and a value of that key that would fit.

    radii_mm : of the cutters that cover the whole lens, each one radius beyond its rim
    depth_mm : of the lens under Z0, as far as it is known
    """
    stock, optics = spec.stock, spec.optics
    sides = (("optics.width_mm", "X", optics.width_mm), ("optics.height_mm", "Y", optics.height_mm))
    for number, (key, axis, side_mm) in enumerate(sides):
        beside_mm, what = max(_list_overhangs(spec, machine, radii_mm, axis), key=lambda one: one[0])
        need_mm, have_mm = side_mm + 2 * beside_mm, machine.travel_mm[number]
        if need_mm <= have_mm + _ROUNDING_MM:
            continue
        most_mm = floor(have_mm - 2 * beside_mm)
        words = Phrase(
            "the job moves {need_mm:.6g} mm along {axis}: the lens of {side_mm:g} mm and, on either side of it, "
            "{beside_mm:.6g} mm for {what}; {machine} travels {travel_mm:g} mm (machine.travel_mm.{number})",
            need_mm=need_mm,
            axis=axis,
            side_mm=side_mm,
            beside_mm=beside_mm,
            what=what,
            machine=machine.name,
            travel_mm=have_mm,
            number=number,
        )
        yield _offer(key, words, most_mm)
    through_mm = 0.0 if stock.cut_out is None else stock.thickness_mm + stock.cut_out.through_mm
    deepest_mm = max(depth_mm, through_mm, stock.skim_mm)
    if machine.safe_z_mm + deepest_mm > machine.travel_mm[2] + _ROUNDING_MM:
        words = Phrase(
            "the job moves {need_mm:.6g} mm along Z, from the safe height of {safe_z_mm:g} mm to {deepest_mm:.4g} mm "
            "under the stock top; {machine} travels {travel_mm:g} mm; allowed: at least that",
            need_mm=machine.safe_z_mm + deepest_mm,
            safe_z_mm=machine.safe_z_mm,
            deepest_mm=deepest_mm,
            machine=machine.name,
            travel_mm=machine.travel_mm[2],
        )
        yield ("machine.travel_mm.2", words), None


def _list_overhangs(
    spec: JobSpec, machine: MachineProfile, radii_mm: Sequence[float], axis: str
) -> Iterator[tuple[float, Phrase]]:
    """Yield the cutters that move beyond the lens, and how far on either side."""
    stock = spec.stock
    radius_mm = max(radii_mm, default=0.0)
    yield radius_mm, Phrase("a cutter of radius {radius_mm:g} mm", radius_mm=radius_mm)
    if machine.trace_outline:
        yield stock.margin_mm, Phrase("the trace around the block (machine.trace_outline)")
    if stock.cut_out is not None:
        yield stock.margin_mm, Phrase("cutting the lens out of its margin (stock.cut_out)")
    if stock.face is not None:
        beyond_mm = stock.face.radius_mm + BESIDE_MM if axis == "X" else 0.0
        yield stock.margin_mm + beyond_mm, Phrase("facing the block (stock.face)")
