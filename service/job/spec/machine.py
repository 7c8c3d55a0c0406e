"""The table `[machine]` of the job spec."""

from __future__ import annotations

from functools import partial
from typing import Annotated, Literal

from pydantic import Field, field_validator

from phrases.phrase import Phrase
from service.job.spec.section import RuleError, Section, Speed, none_or_from, shown

Three = Field(min_length=3, max_length=3)
Travel = Annotated[list[Annotated[float, Field(ge=1, le=100_000)]], Three]
Rates = Annotated[list[Annotated[float, Field(ge=1, le=1_000_000)]], Three]
Accelerations = Annotated[list[Annotated[float, Field(ge=0.1, le=100_000)]], Three]
Pair = Annotated[list[Speed], Field(min_length=2, max_length=2)]
_XYZ = ("X", "Y", "Z")
_USUAL_PROFILE = "grbl"
_shown = partial(shown, usual="machine's")  # missing values come from the profile


class MachineSpec(Section):
    """The mill: a profile by name, and any of its figures set otherwise. Triples are X, Y, Z."""

    profile: Annotated[
        str, shown("Machine", choices={_USUAL_PROFILE: _USUAL_PROFILE}, card="main", first=True, wide=True)
    ] = _USUAL_PROFILE
    travel_mm: Annotated[Travel | None, shown("Travel", names=_XYZ)] = None
    max_rate_mm_per_min: Annotated[Rates | None, shown("Fastest", names=_XYZ)] = None
    acceleration_mm_per_s2: Annotated[Accelerations | None, shown("Acceleration", names=_XYZ)] = None
    step_mm: Annotated[Annotated[float, Field(ge=1e-6, le=1)] | None, _shown("Smallest step")] = None
    z_noise_mm: Annotated[Annotated[float, Field(ge=0, le=0.1), none_or_from(1e-7)] | None, _shown("Noise in Z")] = None
    screw_error_mm: Annotated[
        Annotated[list[Annotated[float, Field(ge=0, le=0.1), none_or_from(1e-7)]], Three] | None,
        shown("Screw errors", "An axis error that repeats with every turn of the screw.", names=_XYZ),
    ] = None
    screw_lead_mm: Annotated[
        Annotated[list[Annotated[float, Field(ge=0.1, le=100)]], Three] | None,
        shown("Leads of the screws", names=_XYZ),
    ] = None
    whole_steps: Annotated[bool | None, _shown("On whole steps")] = None
    most_program_mb: Annotated[
        Annotated[float, Field(ge=0.1, le=1_000_000)] | None, shown("Largest program", usual="no limit")
    ] = None
    most_program_hours: Annotated[
        Annotated[float, Field(ge=0.05, le=10_000)] | None, shown("Longest program", usual="no limit")
    ] = None
    junction_deviation_mm: Annotated[Annotated[float, Field(ge=1e-5, le=1)] | None, _shown("Junction deviation")] = None
    planner_blocks: Annotated[Annotated[int, Field(ge=1, le=100_000)] | None, _shown("Blocks planned ahead")] = None
    lines_per_s: Annotated[Annotated[float, Field(ge=0.1, le=1_000_000)] | None, _shown("Lines per second")] = None
    safe_z_mm: Annotated[Annotated[float, Field(ge=0.5, le=200)] | None, _shown("Safe height")] = None
    spindle_rpm: Annotated[Pair | None, shown("Spindle", names=("slowest", "fastest"))] = None
    collet_mm: Annotated[
        Annotated[float, Field(ge=0.1, le=100)] | None, _shown("Collet", "The thickest shank that it takes.")
    ] = None
    spindle_w: Annotated[Annotated[float, Field(ge=1, le=100_000)] | None, _shown("Spindle power")] = None
    removal_cm3_per_min: Annotated[Annotated[float, Field(ge=0.01, le=10_000)] | None, _shown("Removal, cm³/min")] = (
        None
    )
    coolant: Annotated[Literal["none", "air", "mist", "flood"] | None, _shown("Coolant or air")] = None
    work_offset: Annotated[
        Annotated[int, Field(ge=1, le=6)] | None, _shown("Work offset", "1 to 6: G54 to G59, Okuma's G15 H1 to H6.")
    ] = None
    blend_tolerance_mm: Annotated[
        Annotated[float, Field(ge=0, le=1), none_or_from(1e-5)] | None,
        _shown("Corners rounded by", "LinuxCNC only; 0: exact stop."),
    ] = None
    high_precision: Annotated[
        Literal["none", "g05.1", "g08"] | None,
        _shown("High-precision mode", choices={"none": "none", "g05.1": "G05.1", "g08": "G08"}),
    ] = None
    warm_up_s: Annotated[
        Annotated[float, Field(ge=0, le=3600), none_or_from(0.1)] | None,
        _shown("Spindle warm-up", "In the first program, in steps of speed."),
    ] = None
    trace_outline: Annotated[bool | None, _shown("Trace the block first")] = None

    @field_validator("spindle_rpm")
    @classmethod
    def _slow_then_fast(cls, speeds: list[float] | None) -> list[float] | None:
        if speeds is not None and speeds[0] > speeds[1]:
            raise RuleError(Phrase("{speeds} must hold the slowest speed, then the fastest", speeds=speeds))
        return speeds
