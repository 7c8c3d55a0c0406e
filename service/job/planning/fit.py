"""Checks whether the ball fits the lens and the programs fit the disk. All checks run before the first block is
written.
"""

from __future__ import annotations

import shutil
from math import ceil, isfinite
from pathlib import Path

from cam.checking.check import SEEN_SHARE
from cam.checking.collision import lens_over_flutes_mm
from cam.passes import PassSpec, Stock
from cam.program import LEAST_REACHED
from optics.heightfield import Heightfield
from phrases.phrase import Phrase, join
from service.errors import FailedError, SpecError
from service.job.planning.lens_facts import LensFacts
from service.job.planning.program_size import SURE, pass_bytes
from service.wording import ball


def check_ball_fit(facts: LensFacts, passes: tuple[PassSpec, ...], *, shaped_for_mm: float) -> Phrase | None:
    """Return a warning when the finishing ball does not fit everywhere; SpecError when it touches too little of the
    lens.
    """
    radius_mm = min((spec.radius_mm for spec in passes if spec.finishes), default=0.0)
    if radius_mm <= facts.min_concave_radius_mm:
        return None
    share = facts.reached_share(radius_mm)
    if 1 - share < SEEN_SHARE:
        return None
    fits = _describe_fits(facts)
    if share < LEAST_REACHED:
        number = next(n for n, spec in enumerate(passes) if spec.finishes and spec.radius_mm == radius_mm)
        words = Phrase(
            "{radius_mm:g} touches only {percent:.0f} % of the lens; allowed: at least {least_percent:.0f} %; {fits}",
            radius_mm=radius_mm,
            percent=100 * share,
            least_percent=100 * LEAST_REACHED,
            fits=fits,
        )
        raise SpecError([(f"passes.{number}.radius_mm", words)])
    unfit = Phrase(
        "the finishing ball {size} does not fit {percent:.2g} % of the lens",
        size=ball(radius_mm),
        percent=100 * (1 - share),
    )
    if shaped_for_mm >= radius_mm:
        return join("; ", (unfit, fits))
    remedy = Phrase("optics.min_radius_mm = {radius_mm:g} shapes the lens for it", radius_mm=radius_mm)
    return join("; ", (unfit, fits, remedy))


def _describe_fits(facts: LensFacts) -> Phrase:
    """Describe which balls fit everywhere and nearly everywhere."""
    parts = [
        Phrase("the largest that fits everywhere has {radius_mm:.3g} mm", radius_mm=facts.min_concave_radius_mm),
        *(
            Phrase("on {percent} % of the area {radius_mm:.3g} mm", percent=percent, radius_mm=radius_mm)
            if isfinite(radius_mm)
            else Phrase("on {percent} % of the area any", percent=percent)
            for percent, radius_mm in (("99.9", facts.radius_for_999_mm), ("99", facts.radius_for_99_mm))
        ),
    ]
    return join(", ", parts)


def require_flutes(heightfield: Heightfield, passes: tuple[PassSpec, ...]) -> None:
    """Raise SpecError if flutes are shorter than one bite, or if the lens itself would touch the shank.

    Only stated dimensions of a cutter are checked; the check of each program covers the remaining stock.
    """
    for number, spec in enumerate(passes):
        flutes_mm, key = spec.flute_length_mm, f"passes.{number}.flute_length_mm"
        if flutes_mm is None:
            continue
        if flutes_mm < spec.step_down_mm:
            words = Phrase(
                "{flutes_mm:g} mm is shorter than one bite; allowed: at least the step-down of {least_mm:g} mm",
                flutes_mm=flutes_mm,
                least_mm=spec.step_down_mm,
            )
            raise SpecError([(key, words)])
        if flutes_mm >= heightfield.relief_mm:  # nothing of the lens can stand above them
            continue
        over_mm = lens_over_flutes_mm(heightfield, spec)
        if over_mm > 0:
            least_mm = ceil(10 * (flutes_mm + over_mm)) / 10
            words = Phrase(
                "{flutes_mm:g} mm is too short: where it is deepest the lens beside the cutter stands {over_mm:.2f} mm "
                "above the flutes, within reach of a shank of radius {radius_mm:g} mm; allowed: at least "
                "{least_mm:g} mm",
                flutes_mm=flutes_mm,
                over_mm=over_mm,
                radius_mm=spec.shank_radius_mm or spec.radius_mm,
                least_mm=least_mm,
            )
            raise SpecError([(key, words)], {key: least_mm})


def estimate_bytes(stock: Stock, spec: PassSpec) -> float:
    """Return the approximate size of a program [bytes]."""
    size_mm = (stock.width_mm, stock.height_mm)
    return pass_bytes(size_mm, radius_mm=spec.radius_mm, pitch_mm=spec.pitch_mm, finishes=spec.finishes)


def check_disk_space(folder: Path, disk: Phrase, stock: Stock, passes: tuple[PassSpec, ...]) -> Phrase | None:
    """Return a warning when the disk may not hold the programs; FailedError when it cannot hold a quarter of them.

    disk : name of the folder's disk for the message
    """
    wanted_mb = sum(estimate_bytes(stock, spec) for spec in passes) / 1e6
    free_mb = shutil.disk_usage(folder).free / 1e6
    sentence = Phrase(
        "the programs need about {wanted_mb:.0f} MB, {disk} has {free_mb:.0f} MB free",
        wanted_mb=wanted_mb,
        disk=disk,
        free_mb=free_mb,
    )
    if free_mb < wanted_mb / SURE:
        raise FailedError(sentence)
    return sentence if free_mb < wanted_mb else None
