"""Rules for the values of data files, with the sentence for each, as annotations of the fields."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_type_hints

from machines.gcode.dialects import DIALECTS as GCODE_DIALECTS
from machines.gcode.dialects import RML
from phrases.phrase import Phrase

DIALECTS = (*GCODE_DIALECTS, RML)
DRIVERS = ("grbl", "roland-serial", "roland-usb", "drip", "none")
FLOWS = ("none", "rtscts", "xonxoff")
SPINDLE = ("turns", "stops", "unknown")
COOLANTS = ("none", "air", "mist", "flood")
HIGH_PRECISION = ("none", "g05.1", "g08")
UNITS = ("mm", "inch")


_MOST_BYTES = 1_000_000


class UnreadableFileError(ValueError):
    """A data file that cannot be read; the words follow its name in the message."""

    def __init__(self, words: Phrase) -> None:
        super().__init__(words)
        self.words = words


def read_data(path: Path) -> dict[str, Any]:
    """Return the tables of a data file: TOML, or JSON if its name says so. UnreadableFileError says why it cannot be
    read.
    """
    kind, parse = ("JSON", json.loads) if path.suffix.lower() == ".json" else ("TOML", tomllib.loads)
    try:
        with path.open("rb") as file:
            raw = file.read(_MOST_BYTES + 1)  # a pipe or a device does not report its size
    except OSError as error:
        words = Phrase("cannot be read: {reason}", reason=error.strerror)
        if path.is_dir():
            words = Phrase("is a folder")
        elif isinstance(error, FileNotFoundError):
            words = Phrase("is a link to a file that is not there") if path.is_symlink() else Phrase("no such file")
        raise UnreadableFileError(words) from None
    if len(raw) > _MOST_BYTES:
        raise UnreadableFileError(Phrase("is too large; a file of data has at most {most} bytes", most=_MOST_BYTES))
    try:
        data = parse(raw.decode("utf-8-sig"))  # some editors begin a file with a byte order mark
    except UnicodeDecodeError:
        raise UnreadableFileError(Phrase("is not UTF-8 text; save it as UTF-8")) from None
    except (ValueError, RecursionError) as error:  # ValueError itself: an integer with thousands of digits
        cause = " ".join(str(error).split())
        raise UnreadableFileError(Phrase("not valid {kind}: {cause}", kind=kind, cause=cause)) from None
    if not isinstance(data, dict):
        raise UnreadableFileError(Phrase("must hold a table of keys, not {kind}", kind=type(data).__name__))
    return data


class BadValueError(ValueError):
    """A key with an unusable value: key, value, what is allowed."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        self.words = Phrase("{key} = {value}: allowed: {allowed}", key=key, value=repr(value), allowed=allowed)
        super().__init__(self.words)
        self.key = key


@dataclass(frozen=True, slots=True)
class Rule:
    """`take` returns the value to keep, or raises ValueError or TypeError; `allowed` describes the allowed values.

    limits : least and greatest number, where the value is one or several
    """

    take: Callable[[Any], Any]
    allowed: str
    limits: tuple[float, float] = (-math.inf, math.inf)


class Rules:
    """The keys of one table."""

    def __init__(self, rules: Mapping[str, Rule]) -> None:
        self._rules = dict(rules)

    @classmethod
    def of(cls, kind: type) -> Rules:
        """Return the rules with which the fields of a class are annotated."""
        hints = get_type_hints(kind, include_extras=True)
        annotated = {name: hint.__metadata__ for name, hint in hints.items() if hasattr(hint, "__metadata__")}
        return cls({name: rule for name, (rule,) in annotated.items()})

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(self._rules)

    def limits(self, key: str) -> tuple[float, float]:
        return self._rules[key].limits

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


def _numbers(count: int, low: float, high: float, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise ValueError
    return tuple(_number(low, high, one) for one in value)


def number(low: float, high: float, unit: str = "") -> Rule:
    allowed = Phrase("a number from {low:g} to {high:g}", low=low, high=high)
    if unit:
        allowed = Phrase("a number from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(lambda value: _number(low, high, value), allowed, (low, high))


def triple(low: float, high: float, unit: str) -> Rule:
    allowed = Phrase("three numbers [X, Y, Z] from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(lambda value: _numbers(3, low, high, value), allowed, (low, high))


def pair(low: float, high: float, unit: str) -> Rule:
    def take(value: Any) -> tuple[float, ...]:
        least, most = _numbers(2, low, high, value)
        if least >= most:
            raise ValueError
        return (least, most)

    allowed = Phrase("two numbers [slowest, fastest] from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(take, allowed)


def sides(low: float, high: float, unit: str) -> Rule:
    allowed = Phrase("two numbers [X, Y] from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit)
    return Rule(lambda value: _numbers(2, low, high, value), allowed, (low, high))


def cylinders(low: float, high: float, unit: str) -> Rule:
    def take(value: Any) -> tuple[tuple[float, ...], ...]:
        if not isinstance(value, list):
            raise ValueError
        return tuple(_numbers(2, low, high, one) for one in value)

    allowed = Phrase(
        "a list of pairs [radius, length], each from {low:g} to {high:g} {unit}", low=low, high=high, unit=unit
    )
    return Rule(take, allowed, (low, high))


def names(*known: str) -> Rule:
    def take(value: Any) -> tuple[str, ...]:
        if not isinstance(value, list) or any(one not in known for one in value):
            raise ValueError
        return tuple(value)

    return Rule(take, Phrase("a list of {names}", names=", ".join(known)))


def whole(low: int, high: int) -> Rule:
    def take(value: Any) -> int:
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise ValueError
        return value

    return Rule(take, Phrase("a whole number from {low} to {high}", low=low, high=high), (low, high))


def one_of(*values: object) -> Rule:
    def take(value: Any) -> Any:
        if isinstance(value, bool) or value not in values:
            raise ValueError
        return values[values.index(value)]  # 1.0 for 1

    return Rule(take, ", ".join(f"'{v}'" if isinstance(v, str) else f"{v:g}" for v in values))


def text(most: int, *, least: int = 0) -> Rule:
    """Return the rule for a text without blanks around it. least : 0 or 1"""

    def take(value: Any) -> str:
        if not isinstance(value, str) or not value.isprintable() or not least <= len(value.strip()) <= most:
            raise ValueError
        return value.strip()

    if least:
        return Rule(take, Phrase("text on one line, 1 to {most} characters", most=most))
    return Rule(take, Phrase("text on one line, at most {most} characters", most=most))


def flag() -> Rule:
    def take(value: Any) -> bool:
        if not isinstance(value, bool):
            raise TypeError
        return value

    return Rule(take, Phrase("true or false"))
