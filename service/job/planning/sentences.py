"""A plan in sentences: why these passes, what they cannot show, and what would help."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np

from cam.passes import PassSpec
from cam.planning.planner import DOUBLING_DB, Candidate
from cam.planning.row_slopes import row_slopes
from cam.tools import contact_speed_m_per_min
from optics.metrics import blurred_psnr_db
from service.job.planning.plan import Planned
from service.job.report.milled import UNSEEN_DB
from service.wording import ball, cutter, duration

RUBBING_M_PER_MIN = 10.0
HOPEFUL_DB = 1.5
"""What a milled picture may fall short of the foretold one: grooves spread light less where the picture is bright, and
the foretold one has them everywhere alike (a photograph on 40 mm: 25.0 dB foretold, 24.0 dB by every groove; a soft
picture: 1.4 dB less than foretold).
"""
_NEAR = 0.15  # ball by reach of light: beyond, that differs too much from place to place to be foretold
_SEEN_SHARE = 0.001  # of the lens; less that is filled is not worth a word


def reasons(planned: Planned) -> list[str]:
    """Return why these passes, most important first."""
    first = (_aim(planned), _by_hand(planned))
    found = (*first, *_ball(planned), *_rest(planned), *_rows(planned), *_steps(planned), *_rough(planned))
    return [sentence for sentence in found if sentence]


def blur_warnings(planned: Planned, *, milled_next: bool = False) -> list[str]:
    """Return what the picture loses, and whether the ball rubs. milled_next: the job itself will tell how much it
    blurs.
    """
    found = []
    chosen = planned.chosen
    if not planned.plan.met:
        found.append(_not_met(planned))
    if not milled_next and (lost := blur_warning(planned, chosen, f"; {_remedy(planned)}")):
        found.append(lost)
    if (speed := _speed_at_contact_m_per_min(planned)) < RUBBING_M_PER_MIN:
        found.append(
            "on half of the lens the ball rubs more than it cuts; a larger ball or a faster spindle leaves a clearer "
            f"surface (less than {speed:.0f} m/min; ball of radius {chosen.finish.radius_mm:g} mm, "
            f"Ø {2 * chosen.finish.radius_mm:g})"
        )
    return found


def blur_warning(planned: Planned, one: Candidate, remedy: str = "") -> str | None:
    """Return what a plan cannot show of the picture, if anything; figures last."""
    pixels = planned.blur_px(one)
    if pixels <= 1.0 or blurred_psnr_db(planned.light.target, (pixels / 2**0.5,) * 2) > UNSEEN_DB:
        return None
    return (
        f"the picture's finest detail will not be seen{remedy} (the tool's marks blur it by {one.blur_mm:.2g} mm, "
        f"{pixels:.1f} pixels)"
    )


def finish_words(finish: PassSpec) -> str:
    """Return a finishing pass in a few words."""
    rows = "contours" if finish.strategy == "contour" else f"rows along {finish.direction.upper()}"
    return f"ball {ball(finish.radius_mm)}, pitch {finish.pitch_mm:g} mm, {rows}"


def candidate_words(one: Candidate) -> str:
    """Return how a lens is finished, in a few words."""
    return "; ".join(filter(None, (finish_words(one.finish), rest_words(one))))


def rest_words(one: Candidate) -> str:
    """Return words on the rest pass; nothing where there is none."""
    return "" if one.rest is None else f"then ball {ball(one.rest.spec.radius_mm)} in what it leaves"


def best_possible(planned: Planned) -> str:
    """Return what no plan on this mill can surpass."""
    best = planned.plan.best
    perfect = max(planned.light.perfect_db(radius) for radius in planned.light.lenses)
    return (
        f"No plan does better than {best.psnr_db:.1f} dB on this mill ({duration(3600 * best.hours)}): its steps of "
        f"{1000 * planned.machine.step_mm:g} µm and its noise of {1000 * planned.machine.z_noise_mm:g} µm decide; "
        f"the lens itself could show {perfect:.1f} dB."
    )


def hopeful_db(planned: Planned) -> float | None:
    """Return how much the milled picture may fall short of the foretold one; None: more than can be told."""
    radius_mm = planned.chosen.finish.radius_mm
    reach_mm = planned.light.reach_mm(planned.light.forms[radius_mm])
    return HOPEFUL_DB if radius_mm <= _NEAR * reach_mm else None


def _aim(planned: Planned) -> str:
    chosen, goal = planned.chosen, planned.goal
    less = "several dB less for so near a wall" if (most := hopeful_db(planned)) is None else f"up to {most:g} dB less"
    seen = "once finished by hand" if planned.finishing is not None else f"as milled {less}"
    shown = f"{chosen.psnr_db:.1f} dB, {seen}, in {duration(3600 * chosen.hours)}"
    if not planned.plan.met:
        return f"{shown}, the nearest to what was asked for. {best_possible(planned)}"
    if goal.hours is not None:
        return f"{shown}: the best picture within {goal.hours:g} h. {best_possible(planned)}"
    if goal.blur_mm is not None:
        return f"{shown}: the quickest plan that blurs by no more than {goal.blur_mm:g} mm. {best_possible(planned)}"
    if goal.psnr_db is not None:
        return f"{shown}: the quickest plan that reaches {goal.psnr_db:g} dB. {best_possible(planned)}"
    return f"{shown}: twice the time would not gain {DOUBLING_DB:g} dB. {best_possible(planned)}"


def _by_hand(planned: Planned) -> str:
    """Return which finish, how long, and what the same goal would show without it; nothing where there is none."""
    finishing, without = planned.finishing, planned.unfinished
    if finishing is None:
        return ""
    work = "" if finishing.minutes is None else f", {duration(60 * finishing.minutes)} of work"
    words = f"{finishing.title}{work}, takes off what rows leave; the lens is made for it"
    if without is None:
        return f"{words}."
    best = without.chosen
    gain = planned.chosen.psnr_db - best.psnr_db
    if gain < 0:
        return f"{words}, but it shows {-gain:.1f} dB less than no finish would."
    return f"{words}: {gain:.1f} dB more than the best without, in {duration(3600 * best.hours)} of milling."


def _ball(planned: Planned) -> Iterator[str]:
    """Yield what the ball is chosen for, and which others were not."""
    radius = planned.chosen.finish.radius_mm
    across = 1000 * planned.chosen.slopes.across.rms
    slopes = f"slopes of {across:.1f} µm per mm ({across:.1f} mrad)"
    words = f"A ball {ball(radius)} finishes: its rows leave {slopes}, a smaller ball steeper ones"
    if planned.shapes_lens:
        perfect, least = planned.light.perfect_db(radius), planned.light.perfect_db(min(planned.light.lenses))
        lost = max(0.0, least - perfect)
        words += f"; the lens is shaped for it, which takes {lost:.1f} dB of the {least:.1f} dB of one without marks"
    yield words + "."
    if any(planned.foreseen_blur_mm()):
        plain = planned.light.unsharpened_db(planned.chosen.marks)
        gain = planned.chosen.psnr_db - plain
        yield f"The lens is made sharper by what milling will blur, which gains {gain:.1f} dB on the wall."
    larger = [(name, why) for name, why in planned.plan.left_out if _radius(planned, name) > radius]
    for name, why in larger:
        yield f"Left out, though larger: {name}: {why}."


def _rest(planned: Planned) -> Iterator[str]:
    """Yield what is left in valleys too narrow for the ball, and who takes it out."""
    chosen = planned.chosen
    filled = planned.light.fillings.get(chosen.finish.radius_mm)
    if chosen.rest is not None:
        rest, gain = chosen.rest, planned.rest_gain_db(chosen)
        form = planned.light.forms[chosen.finish.radius_mm]
        share = 100 * rest.extent.area_mm2 / (form.width_mm * form.height_mm)
        places = "one place" if rest.extent.regions == 1 else f"{rest.extent.regions} places"
        yield (
            "It does not fit every valley: a rest pass takes out what it leaves, with a ball "
            f"{ball(rest.spec.radius_mm)} in rows {rest.spec.pitch_mm:g} mm apart, only there: {places}, {share:.2g} % "
            f"of the lens, {duration(rest.extent.seconds)}. That gains {gain:.1f} dB."
        )
    elif filled is not None and filled.share >= _SEEN_SHARE:
        yield (
            f"It leaves {100 * filled.share:.2g} % of the lens filled, in valleys too narrow for it: a rest pass with "
            "a smaller ball would not show enough more for its time."
        )


def _rows(planned: Planned) -> Iterator[str]:
    chosen = planned.chosen
    finish = chosen.finish
    front = planned.plan.front
    sharper = front[front.index(chosen) + 1 :]
    words = f"Rows {finish.pitch_mm:g} mm apart"
    if sharper:
        gain, more_s = sharper[0].psnr_db - chosen.psnr_db, 3600 * (sharper[0].hours - chosen.hours)
        other = candidate_words(sharper[0])
        yield f"{words}; the next sharper plan ({other}) would gain {gain:.2g} dB for {duration(more_s)} more."
    else:
        grain = 100 * planned.light.grain(chosen.marks)
        yield (
            f"{words}: closer ones would not help, as the rows that lie deepest by the mill's noise hide the others "
            + (f"and make stripes, here of {grain:.0f} % of the light.")
        )
    if finish.strategy == "raster":
        gain = chosen.psnr_db - _psnr_turned_db(planned, chosen)
        if gain >= 0.05:
            way, other = finish.direction.upper(), "Y" if finish.direction == "x" else "X"
            yield f"They run along {way}: along {other} their blur would cost this picture {gain:.1f} dB more."


def _steps(planned: Planned) -> Iterator[str]:
    machine, chosen = planned.machine, planned.chosen
    if not machine.whole_steps:
        return
    finish = chosen.finish
    form = planned.light.forms[finish.radius_mm]
    between = row_slopes(
        radius_mm=finish.radius_mm,
        pitch_mm=finish.pitch_mm,
        step_mm=machine.step_mm,
        noise_mm=machine.z_noise_mm,
        vertex_mm=chosen.slopes.vertex_mm,
        steepness=form.steepness(finish),
        tooth_rad=form.tooth_slopes_rad(finish, machine.step_mm),
    )
    gain = chosen.psnr_db - planned.light.aimed_db(replace(chosen.marks, slopes=between))
    yield (
        f"Heights are written in whole steps of the mill, {1000 * machine.step_mm:g} µm: vertices stand where the path "
        f"goes through one, which gains {max(0.0, gain):.1f} dB."
    )


def _rough(planned: Planned) -> Iterator[str]:
    before = planned.chosen.before
    first = before[0]
    tool = cutter(asdict(first))
    words = f"A {tool} roughs in layers of {first.step_down_mm:g} mm, the quickest of the tools"
    if len(before) > 1:
        words += f"; a second rough with {ball(before[1].radius_mm)} is quicker than layers of the finish"
    else:
        words += "; a second rough would not pay"
    yield words + "."


def _not_met(planned: Planned) -> str:
    goal = planned.goal
    if goal.blur_mm is not None:
        return f"plan.blur_mm = {goal.blur_mm:g} cannot be reached: {planned.chosen.blur_mm:.2g} mm is the least"
    return f"plan.psnr_db = {goal.psnr_db or 0:g} cannot be reached: {planned.chosen.psnr_db:.1f} dB is the most"


def _remedy(planned: Planned) -> str:
    """Return what would help most: a larger ball, or a mill that is off by less."""
    largest = max(planned.light.lenses)
    if planned.plan.left_out and any(_radius(planned, name) > largest for name, _ in planned.plan.left_out):
        return "a wider margin of the block leaves room for a larger ball"
    noise_mm = planned.machine.z_noise_mm
    cause = "finer steps of the mill" if planned.chosen.slopes.off_mm > 1.5 * noise_mm else "a steadier mill"
    return f"{cause}, a larger ball, or a coarser picture on a larger screen helps"


def _psnr_turned_db(planned: Planned, chosen: Candidate) -> float:
    """Return the PSNR with the same rows along the other axis."""
    other = replace(chosen.finish, direction="y" if chosen.finish.direction == "x" else "x")
    return planned.light.aimed_db(replace(chosen.marks, spec=other))


def _speed_at_contact_m_per_min(planned: Planned) -> float:
    """Return the speed at the contact on the median slope [m/min]."""
    finish = planned.chosen.finish
    slope = float(np.median(planned.light.forms[finish.radius_mm].slopes))
    return contact_speed_m_per_min(finish.radius_mm, finish.spindle_rpm, slope)


def _radius(planned: Planned, name: str) -> float:
    return planned.radius_of.get(name, 0.0)
