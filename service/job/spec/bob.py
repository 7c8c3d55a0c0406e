"""The table `[finish.bob]` of the job spec: a polishing bob that the shop owns, and the finish that it makes.

The figures of felt are start values, as those of `finishing.toml`: with a coefficient of 8e-5 a bob takes off as much
for its force and speed as the library's felt by hand. The test piece measures k0, which does not depend on either.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from pydantic import Field

from optics.bob import HEAT_LIMIT_MM_PER_S, ORDER, Bob
from phrases.phrase import Phrase
from service.errors import SpecError
from service.job.spec.finish_library import AREA_MM2, Process
from service.job.spec.section import Section, Speed

BOB = "bob"
START_RPM = 10_000.0
"""Makers of mounted felt points allow 10 000 to 20 000 rpm, by size; a guess within that."""

_STEEP = 1.0  # slope for which the spindle's speed is chosen: few lenses are steeper; the check knows the lens
_USUAL_SLOPE = 0.3  # for the minutes before the lens is known; its own slopes decide in the program
_DEFAULT_K0, _K0_RANGE = 3.0, (24.0, 1.2)  # rad/mm


class BobSpec(Section):
    """A ball of felt or foam on the spindle. Left out: the shop has none.

    modulus_mpa      : E / (1 - nu^2): press it on a kitchen scale by compression_mm, and compare with the sheet's force
    shore            : as its maker states the hardness; for the sheet alone
    compression_mm   : how deep the path presses it into the lens
    wear_per_gpa     : Preston's coefficient with its compound: mm off for each GPa and mm of sliding
    spindle_rpm      : left out: 10 000, or as near as the mill and the heat of rubbing allow
    """

    radius_mm: Annotated[float, Field(ge=0.5, le=25)] = 3.0
    modulus_mpa: Annotated[float, Field(ge=0.01, le=100)] = 0.5
    shore: Annotated[str, Field(max_length=20)] | None = None
    compression_mm: Annotated[float, Field(ge=0.02, le=5)] = 0.3
    wear_per_gpa: Annotated[float, Field(ge=1e-4, le=100)] = 0.08
    spindle_rpm: Speed | None = None


def fill_bob(bob: BobSpec, spindle_rpm: tuple[float, float], machine: str) -> BobSpec:
    """Return the bob with its spindle speed, within the mill's range. SpecError names what the mill or heat forbids."""
    low, high = spindle_rpm
    if bob.compression_mm > bob.radius_mm / 4:
        words = Phrase(
            "{compression_mm:g} is more than a quarter of the bob's radius; allowed: at most {most_mm:.3g}",
            compression_mm=bob.compression_mm,
            most_mm=bob.radius_mm / 4,
        )
        raise SpecError([("finish.bob.compression_mm", words)])
    slowest = build_bob(bob, low)
    if (speed := slowest.fastest_mm_per_s(_STEEP)) > HEAT_LIMIT_MM_PER_S:
        words = Phrase(
            "{radius_mm:g} is too large for machine '{machine}': at its slowest, {least_rpm:g} rpm, the bob rubs at "
            "{speed_m_per_s:.1f} m/s where the lens is steep, and felt burns it from {most_m_per_s:.1f} m/s; allowed: "
            "at most {most_mm:.3g}, or a slower spindle",
            radius_mm=bob.radius_mm,
            machine=machine,
            least_rpm=low,
            speed_m_per_s=speed / 1000,
            most_m_per_s=HEAT_LIMIT_MM_PER_S / 1000,
            most_mm=bob.radius_mm * HEAT_LIMIT_MM_PER_S / speed,
        )
        raise SpecError([("finish.bob.radius_mm", words)])
    if bob.spindle_rpm is None:
        by_heat = low * HEAT_LIMIT_MM_PER_S / speed
        return bob.model_copy(update={"spindle_rpm": float(round(min(max(START_RPM, low), high, by_heat)))})
    if not low <= bob.spindle_rpm <= high:
        words = Phrase(
            "{value:g} is not allowed; allowed: {least:g} to {most:g} {unit} on machine '{machine}'",
            value=bob.spindle_rpm,
            least=low,
            most=high,
            unit="rpm",
            machine=machine,
        )
        raise SpecError([("finish.bob.spindle_rpm", words)])
    return bob


def build_bob(bob: BobSpec, spindle_rpm: float | None = None) -> Bob:
    """Return the bob as the optics package's type; spindle_rpm: if the spec has none."""
    rpm = bob.spindle_rpm if spindle_rpm is None else spindle_rpm
    assert rpm is not None  # by fill_bob
    return Bob(
        radius_mm=bob.radius_mm,
        modulus_mpa=bob.modulus_mpa,
        wear_per_mpa=bob.wear_per_gpa / 1000,
        compression_mm=bob.compression_mm,
        spindle_rpm=rpm,
    )


def fit_process(process: Process, spec: BobSpec) -> Process:
    """Return the library's process with the figures of this bob, whose speed is known."""
    bob = build_bob(spec)
    depth_mm = (bob.k0_after(1.0) / _DEFAULT_K0) ** ORDER
    minutes = depth_mm * AREA_MM2 / bob.rate_mm3_per_s(_USUAL_SLOPE) / 60
    return replace(
        process,
        offered=process.title,
        order=ORDER,
        default_k0_rad_per_mm=_DEFAULT_K0,
        k0_exponent=1 / ORDER,
        default_minutes=minutes,
        minutes_range=(
            minutes * (_DEFAULT_K0 / _K0_RANGE[0]) ** ORDER,
            minutes * (_DEFAULT_K0 / _K0_RANGE[1]) ** ORDER,
        ),
        by_area=True,
        depth_um=1000 * depth_mm,
        depth_grows=True,
        pad_mm=2 * bob.contact_mm,
    )
