"""Explains a plan in sentences: why these passes, what they cannot show, and what would help."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace

import numpy as np

from cam.passes import PassSpec
from cam.planning.planner import DOUBLING_DB, Candidate
from cam.planning.row_slopes import row_slopes
from cam.tools import contact_speed_m_per_min
from optics.metrics import blurred_psnr_db
from phrases.phrase import Phrase, join
from service.job.planning.plan import Planned
from service.job.planning.rim_room import advise_on_rims, warn_of_rim_room
from service.job.report.milled import UNSEEN_DB
from service.wording import ball, cutter, duration

RUBBING_M_PER_MIN = 10.0
HOPEFUL_DB = 1.5
"""How much worse a milled picture may be than predicted: grooves spread light less where the picture is bright, and
the prediction has them everywhere alike (a photograph on 40 mm: 25.0 dB predicted, 24.0 dB by every groove; a soft
picture: 1.4 dB less than predicted).
"""
_NEAR = 0.15  # ball over reach of light: above it, the difference varies too much over the lens to be predicted
_SEEN_SHARE = 0.001  # share of the lens; smaller filled parts are not mentioned


def reasons(planned: Planned) -> list[Phrase]:
    """Return why these passes, most important first."""
    first = (_aim(planned), *_by_hand(planned), *filter(None, (advise_on_rims(planned.rim_room),)))
    return [*first, *_ball(planned), *_rest(planned), *_rows(planned), *_steps(planned), _rough(planned)]


def blur_warnings(planned: Planned, *, milled_next: bool = False) -> list[Phrase]:
    """Return what the picture loses, and whether the ball rubs. milled_next: the job itself will report the blur."""
    found = []
    chosen = planned.chosen
    if not planned.plan.met:
        found.append(_not_met(planned))
    if not milled_next and (lost := blur_warning(planned, chosen, _remedy(planned))):
        found.append(lost)
    if not milled_next and (unreached := warn_of_rim_room(planned.rim_room)):
        found.append(unreached)
    if (speed := _speed_at_contact_m_per_min(planned)) < RUBBING_M_PER_MIN:
        found.append(
            Phrase(
                "on half of the lens the ball rubs more than it cuts; a larger ball or a faster spindle leaves a "
                "clearer surface (less than {speed_m_per_min:.0f} m/min; ball of radius {radius_mm:g} mm, Ø "
                "{diameter_mm:g})",
                speed_m_per_min=speed,
                radius_mm=chosen.finish.radius_mm,
                diameter_mm=2 * chosen.finish.radius_mm,
            )
        )
    return found


def blur_warning(planned: Planned, one: Candidate, remedy: Phrase | None = None) -> Phrase | None:
    """Return what a plan cannot show of the picture, if anything; figures last."""
    pixels = planned.blur_px(one)
    if pixels <= 1.0 or blurred_psnr_db(planned.light.target, (pixels / 2**0.5,) * 2) > UNSEEN_DB:
        return None
    if remedy is None:
        return Phrase(
            "the picture's finest detail will not be seen (the tool's marks blur it by {blur_mm:.2g} mm, {blur_px:.1f} "
            "pixels)",
            blur_mm=one.blur_mm,
            blur_px=pixels,
        )
    return Phrase(
        "the picture's finest detail will not be seen; {remedy} (the tool's marks blur it by {blur_mm:.2g} mm, "
        "{blur_px:.1f} pixels)",
        remedy=remedy,
        blur_mm=one.blur_mm,
        blur_px=pixels,
    )


def finish_words(finish: PassSpec) -> Phrase:
    """Describe a finishing pass in a few words."""
    size, pitch_mm = ball(finish.radius_mm), finish.pitch_mm
    if finish.strategy == "contour":
        return Phrase("ball {size}, pitch {pitch_mm:g} mm, contours", size=size, pitch_mm=pitch_mm)
    axis = finish.direction.upper()
    return Phrase("ball {size}, pitch {pitch_mm:g} mm, rows along {axis}", size=size, pitch_mm=pitch_mm, axis=axis)


def candidate_words(one: Candidate) -> Phrase:
    """Describe in a few words how a lens is finished."""
    return join("; ", filter(None, (finish_words(one.finish), rest_words(one))))


def rest_words(one: Candidate) -> Phrase | None:
    """Describe the rest pass; None if there is none."""
    if one.rest is None:
        return None
    return Phrase("then ball {size} in what it leaves", size=ball(one.rest.spec.radius_mm))


def best_possible(planned: Planned) -> Phrase:
    """Describe the best picture that any plan on this mill can show."""
    best = planned.plan.best
    perfect = max(planned.light.perfect_db(radius) for radius in planned.light.lenses)
    return Phrase(
        "No plan does better than {best_db:.1f} dB on this mill ({time}): its steps of {step_um:g} µm and its "
        "noise of {noise_um:g} µm set the limit; the lens itself could show {perfect_db:.1f} dB.",
        best_db=best.psnr_db,
        time=duration(3600 * best.hours),
        step_um=1000 * planned.machine.step_mm,
        noise_um=1000 * planned.machine.z_noise_mm,
        perfect_db=perfect,
    )


def hopeful_db(planned: Planned) -> float | None:
    """Return how much worse than predicted the milled picture may be [dB]; None: unpredictable."""
    radius_mm = planned.chosen.finish.radius_mm
    reach_mm = planned.light.reach_mm(planned.light.forms[radius_mm])
    return HOPEFUL_DB if radius_mm <= _NEAR * reach_mm else None


def _aim(planned: Planned) -> Phrase:
    goal, shown, best = planned.goal, _describe_shown(planned), best_possible(planned)
    if not planned.plan.met:
        return Phrase("{shown}, the nearest to what was asked for. {best}", shown=shown, best=best)
    if goal.hours is not None:
        return Phrase("{shown}: the best picture within {hours:g} h. {best}", shown=shown, hours=goal.hours, best=best)
    if goal.blur_mm is not None:
        return Phrase(
            "{shown}: the quickest plan that blurs by no more than {blur_mm:g} mm. {best}",
            shown=shown,
            blur_mm=goal.blur_mm,
            best=best,
        )
    if goal.psnr_db is not None:
        return Phrase(
            "{shown}: the quickest plan that reaches {psnr_db:g} dB. {best}",
            shown=shown,
            psnr_db=goal.psnr_db,
            best=best,
        )
    return Phrase(
        "{shown}: twice the time would not gain {gain_db:g} dB. {best}", shown=shown, gain_db=DOUBLING_DB, best=best
    )


def _describe_shown(planned: Planned) -> Phrase:
    """Describe what the plan shows, and in which time."""
    psnr_db, time = planned.chosen.psnr_db, duration(3600 * planned.chosen.hours)
    if planned.finishing is not None:
        return Phrase("{psnr_db:.1f} dB, once finished by hand, in {time}", psnr_db=psnr_db, time=time)
    if (most_db := hopeful_db(planned)) is None:
        return Phrase(
            "{psnr_db:.1f} dB, as milled several dB less for so near a wall, in {time}", psnr_db=psnr_db, time=time
        )
    return Phrase(
        "{psnr_db:.1f} dB, as milled up to {most_db:g} dB less, in {time}", psnr_db=psnr_db, most_db=most_db, time=time
    )


def _by_hand(planned: Planned) -> Iterator[Phrase]:
    """Yield the finish, its minutes, and what the same goal would show without it; nothing if there is no finish."""
    finishing, without = planned.finishing, planned.unfinished
    if finishing is None:
        return
    if finishing.minutes is None:
        words = Phrase("{title}, takes off what rows leave; the lens is made for it", title=finishing.title)
    else:
        words = Phrase(
            "{title}, {time} of work, takes off what rows leave; the lens is made for it",
            title=finishing.title,
            time=duration(60 * finishing.minutes),
        )
    if without is None:
        yield Phrase("{words}.", words=words)
        return
    best = without.chosen
    gain = planned.chosen.psnr_db - best.psnr_db
    if gain < 0:
        yield Phrase("{words}, but it shows {less_db:.1f} dB less than no finish would.", words=words, less_db=-gain)
    else:
        yield Phrase(
            "{words}: {gain_db:.1f} dB more than the best without, in {time} of milling.",
            words=words,
            gain_db=gain,
            time=duration(3600 * best.hours),
        )


def _ball(planned: Planned) -> Iterator[Phrase]:
    """Yield the reason for the ball, and the larger balls that were left out."""
    radius = planned.chosen.finish.radius_mm
    size, slope_um_per_mm = ball(radius), 1000 * planned.chosen.slopes.across.rms
    if planned.shapes_lens:
        perfect, least = planned.light.perfect_db(radius), planned.light.perfect_db(min(planned.light.lenses))
        yield Phrase(
            "The finishing ball is {size}: its rows leave slopes of {slope_um_per_mm:.1f} µm per mm "
            "({slope_um_per_mm:.1f} mrad); a smaller ball leaves steeper ones. The lens is shaped for this ball, "
            "which costs {lost_db:.1f} dB of the {least_db:.1f} dB of a lens without marks.",
            size=size,
            slope_um_per_mm=slope_um_per_mm,
            lost_db=max(0.0, least - perfect),
            least_db=least,
        )
    else:
        yield Phrase(
            "The finishing ball is {size}: its rows leave slopes of {slope_um_per_mm:.1f} µm per mm "
            "({slope_um_per_mm:.1f} mrad); a smaller ball leaves steeper ones.",
            size=size,
            slope_um_per_mm=slope_um_per_mm,
        )
    if any(planned.foreseen_blur_mm()):
        plain = planned.light.unsharpened_db(planned.chosen.marks)
        yield Phrase(
            "The lens is made sharper by what milling will blur, which gains {gain_db:.1f} dB on the wall.",
            gain_db=planned.chosen.psnr_db - plain,
        )
    for name, why in planned.plan.left_out:
        if _radius(planned, name) > radius:
            yield Phrase("Left out, though larger: {tool}: {why}.", tool=name, why=why)


def _rest(planned: Planned) -> Iterator[Phrase]:
    """Yield what is left in valleys too narrow for the ball, and the rest pass for them."""
    chosen = planned.chosen
    filled = planned.light.fillings.get(chosen.finish.radius_mm)
    if chosen.rest is not None:
        rest, gain = chosen.rest, planned.rest_gain_db(chosen)
        form = planned.light.forms[chosen.finish.radius_mm]
        share = 100 * rest.extent.area_mm2 / (form.width_mm * form.height_mm)
        count = rest.extent.regions
        yield Phrase(
            "It does not fit every valley: a rest pass takes out what it leaves, with a ball {size} in rows "
            "{pitch_mm:g} mm apart, only there: {places}, {percent:.2g} % of the lens, {time}. That gains "
            "{gain_db:.1f} dB.",
            size=ball(rest.spec.radius_mm),
            pitch_mm=rest.spec.pitch_mm,
            places=Phrase("one place") if count == 1 else Phrase("{count} places", count=count),
            percent=share,
            time=duration(rest.extent.seconds),
            gain_db=gain,
        )
    elif filled is not None and filled.share >= _SEEN_SHARE:
        yield Phrase(
            "It leaves {percent:.2g} % of the lens filled, in valleys too narrow for it: a rest pass with a "
            "smaller ball would take its time and show hardly more.",
            percent=100 * filled.share,
        )


def _rows(planned: Planned) -> Iterator[Phrase]:
    chosen = planned.chosen
    finish = chosen.finish
    front = planned.plan.front
    sharper = front[front.index(chosen) + 1 :]
    if sharper:
        yield Phrase(
            "Rows {pitch_mm:g} mm apart; the next sharper plan ({other}) would gain {gain_db:.2g} dB for {time} more.",
            pitch_mm=finish.pitch_mm,
            other=candidate_words(sharper[0]),
            gain_db=sharper[0].psnr_db - chosen.psnr_db,
            time=duration(3600 * (sharper[0].hours - chosen.hours)),
        )
    else:
        yield Phrase(
            "Rows {pitch_mm:g} mm apart: closer rows would not help. The mill's noise cuts some rows deeper than "
            "others; these hide their neighbours and make stripes, here of {percent:.0f} % of the light.",
            pitch_mm=finish.pitch_mm,
            percent=100 * planned.light.grain(chosen.marks),
        )
    if finish.strategy == "raster":
        gain = chosen.psnr_db - _psnr_turned_db(planned, chosen)
        if gain >= 0.05:
            way, other = finish.direction.upper(), "Y" if finish.direction == "x" else "X"
            yield Phrase(
                "They run along {way}: along {other} their blur would cost this picture {lost_db:.1f} dB more.",
                way=way,
                other=other,
                lost_db=gain,
            )


def _steps(planned: Planned) -> Iterator[Phrase]:
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
    yield Phrase(
        "The program gives heights in whole steps of the mill, {step_um:g} µm: the path's vertices lie where it "
        "crosses a step, which gains {gain_db:.1f} dB.",
        step_um=1000 * machine.step_mm,
        gain_db=max(0.0, gain),
    )


def _rough(planned: Planned) -> Phrase:
    first, *later = planned.chosen.before
    tool = cutter(asdict(first))
    if later:
        return Phrase(
            "A {tool} roughs in layers of {layer_mm:g} mm, the quickest of the tools; a second rough with {size} is "
            "quicker than layers of the finish.",
            tool=tool,
            layer_mm=first.step_down_mm,
            size=ball(later[0].radius_mm),
        )
    return Phrase(
        "A {tool} roughs in layers of {layer_mm:g} mm, the quickest of the tools; a second rough would not pay.",
        tool=tool,
        layer_mm=first.step_down_mm,
    )


def _not_met(planned: Planned) -> Phrase:
    goal = planned.goal
    if goal.blur_mm is not None:
        return Phrase(
            "plan.blur_mm = {blur_mm:g} cannot be reached: {least_mm:.2g} mm is the least",
            blur_mm=goal.blur_mm,
            least_mm=planned.chosen.blur_mm,
        )
    return Phrase(
        "plan.psnr_db = {psnr_db:g} cannot be reached: {most_db:.1f} dB is the most",
        psnr_db=goal.psnr_db or 0,
        most_db=planned.chosen.psnr_db,
    )


def _remedy(planned: Planned) -> Phrase:
    """Return the change that would help most: a larger ball, or a more exact mill."""
    largest = max(planned.light.lenses)
    if planned.plan.left_out and any(_radius(planned, name) > largest for name, _ in planned.plan.left_out):
        return Phrase("a wider margin of the block leaves room for a larger ball")
    if planned.chosen.slopes.off_mm > 1.5 * planned.machine.z_noise_mm:
        return Phrase("finer steps of the mill, a larger ball, or a coarser picture on a larger screen helps")
    return Phrase("a steadier mill, a larger ball, or a coarser picture on a larger screen helps")


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
