"""What each mill can do: travel, speeds, planner, spindle. Read from the TOML files in machines/profiles/."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from importlib import resources
from typing import Any

Triple = tuple[float, float, float]


class UnknownProfileError(LookupError):
    """No profile has this name; `known` lists those that exist."""

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        super().__init__(f"no machine profile is called '{name}'; known: {', '.join(known)}")
        self.name = name
        self.known = known


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineProfile:
    """One mill. Triples are X, Y, Z.

    travel_mm              : how far each axis goes
    max_rate_mm_per_min    : fastest rate of each axis
    acceleration_mm_per_s2 : acceleration of each axis
    step_mm                : smallest move of an axis
    junction_deviation_mm  : GRBL's $11, how far a corner may be rounded in the planner's model
    planner_blocks         : moves the planner looks ahead
    lines_per_s            : blocks the controller can take in a second
    spindle_rpm            : slowest and fastest speed
    safe_z_mm              : height above the stock top at which rapids travel
    """

    name: str
    dialect: str
    travel_mm: Triple
    max_rate_mm_per_min: Triple
    acceleration_mm_per_s2: Triple
    step_mm: float
    junction_deviation_mm: float
    planner_blocks: int
    lines_per_s: float
    spindle_rpm: tuple[float, float]
    safe_z_mm: float


def profile_names() -> tuple[str, ...]:
    """Names of all profiles, sorted."""
    folder = resources.files("machines") / "profiles"
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml")))


def load_profile(name: str) -> MachineProfile:
    """The profile called `name`; UnknownProfileError lists the known ones."""
    known = profile_names()
    if name not in known:
        raise UnknownProfileError(name, known)
    text = (resources.files("machines") / "profiles" / f"{name}.toml").read_text(encoding="utf-8")
    values = tomllib.loads(text)
    expected = {field.name for field in fields(MachineProfile)}
    if set(values) != expected:
        raise ValueError(f"profile {name}: keys differ from MachineProfile: {sorted(set(values) ^ expected)}")
    kept: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}
    return MachineProfile(**kept)
