"""A controller's reports on itself: $$ (settings), $I (version, buffers), $# (offsets), $G (modal state)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from machines.driver import Triple
from machines.grbl.replies import Push, Reply, Setting
from phrases.phrase import Phrase

MM_PER_INCH = 25.4
# In both, a letter of [OPT:] says that M7 is built in; of FluidNC that is not known.
MIST, _TELL_MIST = "M", frozenset({"grbl", "grblhal"})
# Settings that define machine coordinates. GRBL counts steps: the settings for steps per mm, direction, and the place
# where homing starts to count.
FRAME_SETTINGS = frozenset(
    {
        3,  # direction of each axis: the same count lies on the other side
        22,  # homing, and on grblHAL whether it counts from 0: where the frame begins
        23,  # homing direction: which end of the travel the frame begins at
        27,  # pull-off: a frame with a forced origin begins that far from the switch
        100, 101, 102,  # steps per mm: every coordinate is scaled
        130, 131, 132,  # travel: an axis that homes to its low end counts from there
        150, 151, 152,  # microsteps of a driver that grblHAL sets: they scale as steps per mm do
        160, 161, 162,  # backlash that grblHAL compensates: every reversal lies elsewhere
    }
)  # fmt: skip
OFFSET_TAGS = frozenset({"G54", "G55", "G56", "G57", "G58", "G59", "G59.1", "G59.2", "G59.3", "G28", "G30", "G92"})


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSettings:
    """Parsed answers. Triples are X, Y, Z; None if the controller does not say.

    values  : $n -> text as reported
    offsets : "G54" ... "G59", "G28", "G30", "G92" -> triple in mm; "TLO" -> (0, 0, length)
    """

    values: dict[int, str] = field(default_factory=dict)
    version: str = ""
    options: str = ""
    firmware: str = "grbl"  # "grbl" | "grblhal" | "fluidnc"
    planner_blocks: int | None = None
    rx_bytes: int | None = None
    offsets: dict[str, Triple] = field(default_factory=dict)
    parser_state: str = ""  # words of [GC:...]
    _numbers: dict[int, float] = field(init=False, repr=False, compare=False, default_factory=dict)

    def __post_init__(self) -> None:
        for setting, text in self.values.items():  # computed once: status reports need some of them many times a second
            with suppress(ValueError):
                self._numbers[setting] = float(text)

    def number(self, setting: int) -> float | None:
        return self._numbers.get(setting)

    def _triple(self, first: int) -> Triple | None:
        x, y, z = (self.number(first + axis) for axis in range(3))
        return None if x is None or y is None or z is None else (x, y, z)

    def _flag(self, setting: int) -> bool | None:
        value = self.number(setting)
        return None if value is None else bool(int(value) & 1)

    @property
    def step_mm(self) -> Triple | None:
        """Smallest move of each axis (1 / $100-$102)."""
        steps = self._triple(100)
        return None if steps is None or min(steps) <= 0.0 else (1 / steps[0], 1 / steps[1], 1 / steps[2])

    @property
    def max_rate_mm_per_min(self) -> Triple | None:
        """$110-$112."""
        return self._triple(110)

    @property
    def acceleration_mm_per_s2(self) -> Triple | None:
        """$120-$122."""
        return self._triple(120)

    @property
    def travel_mm(self) -> Triple | None:
        """$130-$132."""
        return self._triple(130)

    @property
    def reach_mm(self) -> tuple[tuple[float, float], ...] | None:
        """Least and greatest machine coordinate of each axis.

        From -travel to 0, or from 0 to travel for an axis that homes to its low end in a firmware with a forced origin
        ($I says Z; grblHAL: 8 in $22).
        """
        if self.travel_mm is None:
            return None
        forced = "Z" in self.options or (self.firmware == "grblhal" and bool(int(self.number(22) or 0) & 8))
        low_ends = int(self.number(23) or 0) if forced else 0
        return tuple((0.0, mm) if low_ends >> axis & 1 else (-mm, 0.0) for axis, mm in enumerate(self.travel_mm))

    @property
    def arc_tolerance_mm(self) -> float | None:
        """$12."""
        return self.number(12)

    @property
    def reports_in_inch(self) -> bool:
        """$13."""
        return bool(self._flag(13))

    @property
    def unit_mm(self) -> float:
        """mm in one unit of a report."""
        return MM_PER_INCH if self.reports_in_inch else 1.0

    @property
    def soft_limits(self) -> bool | None:
        """$20."""
        return self._flag(20)

    @property
    def hard_limits(self) -> bool | None:
        """$21."""
        return self._flag(21)

    @property
    def homing(self) -> bool | None:
        """$22."""
        return self._flag(22)

    @property
    def laser_mode(self) -> bool | None:
        """$32."""
        return self._flag(32)

    @property
    def option_letters(self) -> str | None:
        """Letters of [OPT:]; None if the controller does not say."""
        return self.options.partition(",")[0] if self.options else None

    @property
    def mist(self) -> bool | None:
        """Return whether the controller is built with M7; None if it does not say."""
        letters = self.option_letters
        return None if letters is None or self.firmware not in _TELL_MIST else MIST in letters

    def to_dict(self) -> dict[str, Any]:
        return {
            "values": {str(number): value for number, value in sorted(self.values.items())},
            "version": self.version,
            "options": self.options,
            "firmware": self.firmware,
            "planner_blocks": self.planner_blocks,
            "rx_bytes": self.rx_bytes,
            "offsets": {name: list(value) for name, value in sorted(self.offsets.items())},
            "parser_state": self.parser_state,
        }


def list_frame_changes(before: Mapping[int, str], now: Mapping[int, str]) -> tuple[str, ...]:
    """Return each setting of FRAME_SETTINGS that has changed, as "$100 250.000 -> 252.000".

    A setting that is missing before or now is left out.
    """
    both = ((number, before[number], now[number]) for number in sorted(FRAME_SETTINGS & before.keys() & now.keys()))
    return tuple(f"${number} {was} -> {is_now}" for number, was, is_now in both if not _is_equal(was, is_now))


def _is_equal(before: str, now: str) -> bool:
    try:
        return float(before) == float(now)
    except ValueError:
        return before == now


def read_settings(replies: Iterable[Reply], banner: str = "") -> ControllerSettings:
    """Return settings from the answers to $I, $$, $# and $G, in any order. What cannot be read stays unknown."""
    heard = list(replies)
    values = {reply.number: reply.value for reply in heard if isinstance(reply, Setting)}
    pushes = [reply for reply in heard if isinstance(reply, Push)]
    unit_mm = MM_PER_INCH if values.get(13, "0").strip() == "1" else 1.0
    texts = {push.tag: push.body for push in pushes}
    blocks, rx_bytes = _buffers(texts.get("OPT", ""))
    return ControllerSettings(
        values=values,
        version=texts.get("VER", "").rstrip(":"),
        options=texts.get("OPT", ""),
        firmware=_firmware(banner + texts.get("VER", "") + texts.get("FIRMWARE", "")),
        planner_blocks=blocks,
        rx_bytes=rx_bytes,
        offsets=_offsets(pushes, unit_mm),
        parser_state=texts.get("GC", ""),
    )


_STATE_WORD = re.compile(r"[GMTFSH]-?\d+(?:\.\d*)?")
_STATE_GROUPS = tuple(
    frozenset(group.split())
    for group in ("G54 G55 G56 G57 G58 G59 G59.1 G59.2 G59.3", "G17 G18 G19", "G20 G21", "G90 G91", "G93 G94 G95")
)


def is_parser_state(words: str) -> bool:
    """Return whether this is a complete [GC:] report: words only, and one of each modal group that a program depends
    on.
    """
    parts = words.split()
    return all(map(_STATE_WORD.fullmatch, parts)) and all(len(group & set(parts)) == 1 for group in _STATE_GROUPS)


def _firmware(words: str) -> str:
    low = words.lower()
    return "fluidnc" if "fluidnc" in low else "grblhal" if "grblhal" in low else "grbl"


def _buffers(options: str) -> tuple[int | None, int | None]:
    """Parse `V,15,128` -> (15, 128). FluidNC gives letters only."""
    parts = options.split(",")
    if len(parts) < 3 or not (parts[1].isdecimal() and parts[2].isdecimal()):
        return None, None
    blocks, rx_bytes = int(parts[1]), int(parts[2])
    return (blocks or None), (rx_bytes if rx_bytes >= 32 else None)


def _offsets(pushes: Iterable[Push], unit_mm: float) -> dict[str, Triple]:
    offsets: dict[str, Triple] = {}
    for push in pushes:
        if push.tag not in OFFSET_TAGS and push.tag != "TLO":
            continue
        try:
            numbers = [float(part) * unit_mm for part in push.body.split(",")]
        except ValueError:
            continue
        if push.tag == "TLO":
            x, y, z = (0.0, 0.0, numbers[0]) if len(numbers) == 1 else (*numbers, 0.0, 0.0)[:3]
            offsets["TLO"] = (x, y, z)
        elif len(numbers) >= 3:
            offsets[push.tag] = (numbers[0], numbers[1], numbers[2])
    return offsets


def find_missing_option(settings: ControllerSettings, *, mist_line: int) -> Phrase:
    """Describe why this controller would refuse a block of the program in the middle of a cut; "" if it would not.

    mist_line : first line with M7, 0 for none. The result is "" if the controller does not state its options.
    """
    if not mist_line or settings.mist is not False:
        return Phrase("")
    return Phrase(
        "line {line}: M7 (mist) is error:20 on this controller: it is built without it ([OPT:{options}] has no M); "
        "take M7 out of the program, or use M8",
        line=mist_line,
        options=settings.options,
    )
