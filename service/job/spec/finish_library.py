"""The finish library: processes for finishing a milled lens by hand, as transfer functions, minutes and sentences.

`finishing.toml` beside this module holds the usual processes; tables of a person's own finishing.toml, beside their own
tools.toml, are added to them or take their place. All figures are start values: a test piece measures a shop's own.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from machines.profile_values import BadValueError, Rule, Rules, flag, number, text
from phrases.phrase import Phrase
from service.errors import InputError
from service.job.spec.own_files import find_own_file, read_library

_BUILT_IN = Path(__file__).with_name("finishing.toml")
_NAME = _BUILT_IN.name
_SENTENCES, _LISTS = ("title", "removal", "when_to_stop", "law"), ("needs", "steps", "donts")
_LEVELLED, _KEPT = 0.1, 0.9  # of a wave's height
LONGEST_PAD_MM = 500.0  # larger: no tool touches the lens (a film or a flame)
LEAST_K0_RAD_PER_MM = 0.3  # with less, a wave of 21 mm keeps 37 % of its height at most: no picture is left
ORDER_RANGE = (0.5, 8.0)
DEPTH_RANGE_UM = (-500.0, 500.0)
LEAST_PAD_MM = 0.5
AREA_MM2 = 10_000.0  # area for the minutes of a process that goes over the lens piece by piece


@dataclass(frozen=True, slots=True, kw_only=True)
class Process:
    """A process for finishing a lens: of a wave of k rad/mm it leaves H(k) = exp(-(k/k0)^order).

    offered         : the page's words for it; "best" tries only processes with such words, which a maker can repeat and
                      which leave no stress in the block; empty: available only by its name
    order           : 1, 2 or 4, by the physics (`law`)
    depth_um        : depth that comes off in `default_minutes`; negative if a layer is added
    pad_mm          : size of the tool that follows the form; longer waves are not levelled; inf: no tool touches it,
                      the process levels as a film, everywhere
    default_minutes : per 100 cm2 if `by_area`, otherwise for a lens of any size; likewise `minutes_range`
    default_k0_rad_per_mm, k0_exponent : k0 after the default minutes, and the power of the minutes it falls with
    """

    name: str
    title: str
    offered: str
    order: float
    default_k0_rad_per_mm: float
    k0_exponent: float
    default_minutes: float
    minutes_range: tuple[float, float]
    by_area: bool
    depth_um: float
    depth_grows: bool
    pad_mm: float
    needs: tuple[str, ...]
    steps: tuple[str, ...]
    removal: str
    when_to_stop: str
    donts: tuple[str, ...]
    law: str

    def minutes(self, area_mm2: float) -> float:
        """Return the default minutes for a lens of that area."""
        return self.default_minutes * self._lenses(area_mm2)

    def least_and_most_minutes(self, area_mm2: float) -> tuple[float, float]:
        """Return the least and the most minutes for which the law is known to hold, for a lens of that area."""
        low, high = self.minutes_range
        return low * self._lenses(area_mm2), high * self._lenses(area_mm2)

    def k0_rad_per_mm(self, minutes: float, area_mm2: float) -> float:
        """Return the k at which H has fallen to 1/e after that many minutes on a lens of that area; inf: nothing is
        levelled.

        minutes  : of work on the whole lens, >= 0
        area_mm2 : of the whole lens, > 0
        """
        part = self._part(minutes, area_mm2)
        return self.default_k0_rad_per_mm * part**-self.k0_exponent if part > 0 else math.inf

    def depth_after_um(self, minutes: float, area_mm2: float) -> float:
        """Return the depth that comes off in that many minutes on a lens of that area; negative if a layer is added."""
        part = self._part(minutes, area_mm2)
        return self.depth_um * part if self.depth_grows else self.depth_um * (part > 0)

    def minutes_to(self, k0_rad_per_mm: float, area_mm2: float) -> float:
        """Return the minutes after which k0 has fallen to this value; inf if it never does."""
        if k0_rad_per_mm >= self.k0_rad_per_mm(0.0, area_mm2):
            return 0.0
        if math.isinf(self.default_k0_rad_per_mm):
            return math.inf
        return self.minutes(area_mm2) * (self.default_k0_rad_per_mm / k0_rad_per_mm) ** (1 / self.k0_exponent)

    def _part(self, minutes: float, area_mm2: float) -> float:
        """Return the minutes as a multiple of the default ones."""
        return minutes / self.minutes(area_mm2) if self.default_minutes > 0 else 0.0

    def _lenses(self, area_mm2: float) -> float:
        return area_mm2 / AREA_MM2 if self.by_area else 1.0


def instruct_finishing(
    finish: Mapping[str, Any], processes: Mapping[str, Process], *, area_mm2: float
) -> dict[str, Any] | None:
    """Return the instructions for a job's finish as plain values; None if the job has none.

    finish    : table `finish` of the spec: process, and, if given, k0_rad_per_mm, order, depth_um, minutes, pad_mm
    processes : by name
    area_mm2  : of the lens
    returns   : report `finishing`: title, minutes (of the whole lens, with the known range), depth_um, the
               wavelengths that are levelled (a tenth is left) and kept (nine tenths are), the run-out that rims need,
               and the sentences of the process; figures without a process of the library have none
    """
    name = str(finish.get("process") or "none")
    process = processes.get(name)
    k0, order, depth_um, pad_mm = (finish.get(key) for key in ("k0_rad_per_mm", "order", "depth_um", "pad_mm"))
    if name == "none" and k0 is None:
        return None
    title = Phrase("a finish of your own") if name == "none" else name
    instructions: dict[str, Any] = {"process": name, "title": title, "minutes": finish.get("minutes")}
    instructions |= {"needs": [], "steps": [], "donts": []}
    if process is not None:
        minutes = process.minutes(area_mm2) if instructions["minutes"] is None else instructions["minutes"]
        low, high = process.least_and_most_minutes(area_mm2)
        instructions |= {
            "minutes": minutes,
            "least_minutes": low,
            "most_minutes": high,
            **{key: [say(one) for one in getattr(process, key)] for key in _LISTS},
            **{key: say(getattr(process, key)) for key in _SENTENCES},
        }
        k0 = process.k0_rad_per_mm(minutes, area_mm2) if k0 is None else k0
        order = process.order if order is None else order
        depth_um = process.depth_after_um(minutes, area_mm2) if depth_um is None else depth_um
        pad_mm = process.pad_mm if pad_mm is None else pad_mm
    instructions |= {"k0_rad_per_mm": k0, "order": order, "depth_um": depth_um}
    if pad_mm is not None and pad_mm <= LONGEST_PAD_MM:
        instructions["pad_mm"] = pad_mm
    if k0 is not None and order is not None and math.isfinite(k0):
        instructions |= {
            "levelled_mm": wavelength_mm(_LEVELLED, k0, order),
            "kept_mm": wavelength_mm(_KEPT, k0, order),
            "run_out_mm": 3 * math.sqrt(2) / k0,
        }
    return instructions


def say(text: str) -> str:
    """Return a sentence of a built-in process as a phrase; one of a person's own as it is written."""
    return built_in_sentences().get(text, text)


@cache
def built_in_sentences() -> Mapping[str, Phrase]:
    """Return the sentences of the built-in processes, by text."""
    processes = built_in_processes().values()
    texts = [getattr(one, key) for one in processes for key in _SENTENCES]
    texts += [text for one in processes for key in _LISTS for text in getattr(one, key)]
    return {text: Phrase.of_text(text) for text in texts}


def wavelength_mm(share: float, k0_rad_per_mm: float, order: float) -> float:
    """Return the length of the wave that keeps this share (between 0 and 1) of its height."""
    return 2 * math.pi / (k0_rad_per_mm * math.log(1 / share) ** (1 / order))


def load_processes(own: Path | None = None) -> dict[str, Process]:
    """Return all processes by name: the built-in ones, and those of a person's own file.

    own : that file; left out: the one in the person's configuration folder, if there is one. A process with the name of
          a built-in one is offered in the same way
    InputError names file, process, key, value and what is allowed.
    """
    found = dict(built_in_processes())
    if own is None:
        own = find_own_file(_NAME)
        if own is None or not own.is_file():
            return found
    for name, one in _read(own).items():
        built_in = found.get(name)
        found[name] = replace(one, offered=built_in.offered) if built_in and not one.offered else one
    return found


@cache
def built_in_processes() -> Mapping[str, Process]:
    return _read(_BUILT_IN)


def _read(path: Path) -> dict[str, Process]:
    data = read_library(path)
    for name, row in data.items():
        if not isinstance(row, dict):
            raise InputError(
                Phrase(
                    "{path}: {name}: must be a table of a process, under a line {line}",
                    path=path,
                    name=name,
                    line=f"[{name}]",
                )
            )
    return {name: _process(path, name, row) for name, row in data.items()}


def _process(path: Path, name: str, row: dict[str, Any]) -> Process:
    place = f"{path}: {name}"
    if not re.fullmatch(r"[a-z][a-z0-9-]{0,39}", name):
        raise InputError(
            Phrase("{place}: allowed as a name: lower-case letters, digits and hyphens, at most 40", place=place)
        )
    try:
        values = {key: _VALUES.check(key, value, "") for key, value in row.items()}
        if missing := [key for key in _NEEDED if key not in values]:
            raise InputError(Phrase("{place}: {keys}: missing", place=place, keys=", ".join(missing)))
        minutes = values["default_minutes"]
        left_out = {
            "k0_exponent": 1 / values["order"],  # the levelling, k0^-order, grows in proportion to the time
            "minutes_range": (minutes / 4, minutes * 4),
            "by_area": True,
            "depth_um": 0.0,
            "depth_grows": True,
            "pad_mm": math.inf,
            **dict.fromkeys(("needs", "steps", "donts"), ()),
            **dict.fromkeys(("offered", "removal", "when_to_stop", "law"), ""),
        }
        process = Process(name=name, default_k0_rad_per_mm=values.pop("k0_rad_per_mm"), **{**left_out, **values})
        low, high = process.minutes_range
        if not low <= minutes <= high:
            within = Phrase("within minutes_range, {least:g} to {most:g}", least=low, most=high)
            raise BadValueError("default_minutes", row["default_minutes"], within)
        if minutes == 0 and math.isfinite(process.default_k0_rad_per_mm):
            raise BadValueError("default_minutes", 0, Phrase("more than 0 where k0_rad_per_mm is finite"))
    except BadValueError as error:
        raise InputError(Phrase("{place}: {cause}", place=place, cause=error.words)) from None
    return process


def _sentences(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or len(value) > 20:
        raise ValueError
    return tuple(_TEXT.take(row) for row in value)


def _range(value: Any) -> tuple[float, float]:
    low, high = (_MINUTES.take(one) for one in value)
    if low > high:
        raise ValueError
    return low, high


def _k0(value: Any) -> float:
    return math.inf if value == math.inf else float(_FINITE_K0.take(value))


_MOST_MINUTES = 10_000
_NEEDED = ("title", "order", "k0_rad_per_mm", "default_minutes")
_TEXT = text(600, least=1)
_TEXTS = Rule(_sentences, Phrase("a list of at most 20 sentences"))
_MINUTES = number(0, _MOST_MINUTES, "minutes")
_FINITE_K0 = number(LEAST_K0_RAD_PER_MM, math.inf)
_VALUES = Rules(
    {
        "title": _TEXT,
        "offered": _TEXT,
        "order": number(*ORDER_RANGE),
        "k0_rad_per_mm": Rule(
            _k0,
            Phrase("a number from {least:g} rad/mm, or inf where nothing is levelled", least=LEAST_K0_RAD_PER_MM),
        ),
        "k0_exponent": number(0.05, 4),
        "default_minutes": _MINUTES,
        "minutes_range": Rule(_range, Phrase("two numbers [least, most] from 0 to {most} minutes", most=_MOST_MINUTES)),
        "by_area": flag(),
        "depth_um": number(*DEPTH_RANGE_UM, "um"),
        "depth_grows": flag(),
        "pad_mm": number(LEAST_PAD_MM, LONGEST_PAD_MM, "mm"),
        "needs": _TEXTS,
        "steps": _TEXTS,
        "removal": _TEXT,
        "when_to_stop": _TEXT,
        "donts": _TEXTS,
        "law": _TEXT,
    }
)
