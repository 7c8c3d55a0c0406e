"""Which keys a profile file may have, what each may hold, and the sentence that says so."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from machines.gcode.dialects import DIALECTS as GCODE_DIALECTS
from machines.gcode.dialects import RML
from phrases.phrase import Phrase

DIALECTS = (*GCODE_DIALECTS, RML)
DRIVERS = ("grbl", "roland-serial", "roland-usb", "drip", "none")
FLOWS = ("none", "rtscts", "xonxoff")
SPINDLE = ("turns", "stops", "unknown")
COOLANTS = ("none", "air", "mist", "flood")
HIGH_PRECISION = ("none", "g05.1", "g08")


class BadValueError(ValueError):
    """One key that cannot be taken: key, value, what is allowed."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        self.words = Phrase("{key} = {value}: allowed: {allowed}", key=key, value=repr(value), allowed=allowed)
        super().__init__(self.words)
        self.key = key


@dataclass(frozen=True, slots=True)
class Rule:
    """`take` returns the value to keep, or raises ValueError or TypeError; `allowed` says what it takes."""

    take: Callable[[Any], Any]
    allowed: str


class Rules:
    """The keys of one table."""

    def __init__(self, rules: Mapping[str, Rule]) -> None:
        self._rules = dict(rules)

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self._rules)

    def check(self, key: str, value: object, prefix: str) -> Any:
        rule = self._rules.get(key)
        if rule is None:
            raise BadValueError(prefix + key, value, Phrase("the keys {keys}", keys=", ".join(self._rules)))
        try:
            return rule.take(value)
        except (ValueError, TypeError):
            raise BadValueError(prefix + key, value, rule.allowed) from None


def _number(low: float, high: float, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    if not math.isfinite(value) or not low <= value <= high:
        raise ValueError
    return float(value)


def number(low: float, high: float, unit: str = "") -> Rule:
    allowed = Phrase("a number from {low:g} to {high:g}", low=low, high=high)
    if unit:
        allowed = Phrase("a number from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(lambda value: _number(low, high, value), allowed)


def triple(low: float, high: float, unit: str) -> Rule:
    def take(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != 3:
            raise ValueError
        return tuple(_number(low, high, v) for v in value)

    allowed = Phrase("three numbers [X, Y, Z] from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(take, allowed)


def pair(low: float, high: float, unit: str) -> Rule:
    def take(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != 2:
            raise ValueError
        least, most = (_number(low, high, v) for v in value)
        if least >= most:
            raise ValueError
        return (least, most)

    allowed = Phrase("two numbers [slowest, fastest] from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(take, allowed)


def whole(low: int, high: int) -> Rule:
    def take(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return Rule(take, Phrase("a whole number from {low} to {high}", low=low, high=high))


def one_of(*values: object) -> Rule:
    def take(value: Any) -> Any:
        if isinstance(value, bool) or value not in values:
            raise ValueError
        return values[values.index(value)]  # 1.0 for 1

    return Rule(take, ", ".join(f"'{v}'" if isinstance(v, str) else f"{v:g}" for v in values))


def text(most: int) -> Rule:
    def take(value: Any) -> str:
        if not isinstance(value, str) or not value.isprintable() or not len(value) <= most:
            raise ValueError
        return value

    return Rule(take, Phrase("text on one line, at most {most} characters", most=most))


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


PROFILE_VALUES = Rules(
    {
        "name": text(80),
        "description": text(300),
        "dialect": one_of(*DIALECTS),
        "travel_mm": triple(1, 100_000, "mm"),
        "max_rate_mm_per_min": triple(1, 1_000_000, "mm/min"),
        "acceleration_mm_per_s2": triple(0.1, 100_000, "mm/s2"),
        "step_mm": number(1e-6, 1, "mm"),
        "z_noise_mm": number(0, 0.1, "mm"),
        "screw_error_mm": triple(0, 0.1, "mm"),
        "screw_lead_mm": triple(0.1, 100, "mm"),
        "whole_steps": Rule(_flag, "true, false"),
        "most_program_mb": number(0.1, 1_000_000, "MB"),
        "most_program_hours": number(0.05, 10_000, "hours"),
        "coolant": one_of(*COOLANTS),
        "work_offset": whole(1, 6),
        "blend_tolerance_mm": number(0, 1, "mm"),
        "high_precision": one_of(*HIGH_PRECISION),
        "warm_up_s": number(0, 3600, "s"),
        "trace_outline": Rule(_flag, "true, false"),
        "junction_deviation_mm": number(1e-5, 10, "mm"),
        "planner_blocks": whole(2, 100_000),
        "lines_per_s": number(0.1, 1_000_000),
        "spindle_rpm": pair(0, 1_000_000, "rpm"),
        "safe_z_mm": number(0, 10_000, "mm"),
        "collet_mm": number(0.1, 100, "mm"),
        "spindle_w": number(1, 100_000, "W"),
        "removal_cm3_per_min": number(0.01, 10_000, "cm3/min"),
        "top_z_mm": number(-10_000, 10_000, "mm"),
        "homing": Rule(_flag, "true, false"),
    }
)
LINK_VALUES = Rules(
    {
        "driver": one_of(*DRIVERS),
        "baud": whole(300, 12_000_000),
        "bytesize": one_of(7, 8),
        "parity": one_of("N", "E", "O"),
        "stopbits": one_of(1.0, 1.5, 2.0),
        "flow": one_of(*FLOWS),
        "rx_bytes": whole(16, 1_000_000),
        "port": text(400),
    }
)
SPINDLE_VALUES = Rules({"on_hold": one_of(*SPINDLE), "on_lost_link": one_of(*SPINDLE)})
