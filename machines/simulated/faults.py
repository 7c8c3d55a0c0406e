"""What goes wrong, when: faults on the wire and at the mill, by plan or by seed, and a log of what was done."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

# Faults of one byte on the way to the mill ("sent") or back ("reply").
SENT_KINDS = ("drop", "flip", "duplicate", "delay")
REPLY_KINDS = ("lose-reply", "duplicate-reply", "mangle-reply", "drop-reply-byte", "delay-reply")
MILL_KINDS = ("disconnect", "power-cycle", "reset-button", "hold-button", "start-button", "door", "eeprom-stall")
KINDS = (*SENT_KINDS, *REPLY_KINDS, *MILL_KINDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault. Exactly one of byte, line, at_s says when.

    byte      : index of the byte on the wire, from 0: to the mill for SENT_KINDS and MILL_KINDS, from it for replies
    line      : with that line end received (from 1), or that `ok`/`error` reply sent (REPLY_KINDS)
    at_s      : simulated time
    mask      : bits turned over by "flip" and "mangle-reply"
    length_s  : of a delay, an EEPROM stall, a disconnect (0: stays away until replug), an open door
    """

    kind: str
    byte: int | None = None
    line: int | None = None
    at_s: float | None = None
    mask: int = 0x01
    length_s: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"fault '{self.kind}' is unknown; known: {', '.join(KINDS)}")
        if sum(v is not None for v in (self.byte, self.line, self.at_s)) != 1:
            raise ValueError(f"fault '{self.kind}' needs exactly one of byte, line and at_s to say when")


@dataclass(frozen=True, slots=True)
class FaultDone:
    """A fault as it was carried out: time, kind, byte index on its wire, lines the mill had received."""

    at_s: float
    kind: str
    byte: int
    line: int
    words: str = ""


@dataclass(slots=True)
class Faults:
    """A plan of faults and the log of those that happened."""

    plan: Sequence[Fault] = ()
    log: list[FaultDone] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.plan = tuple(self.plan)

    @classmethod
    def by_seed(
        cls, seed: int, *, kinds: Iterable[str] = KINDS, count: int = 1, lines: tuple[int, int] = (20, 1000)
    ) -> Faults:
        """Return `count` faults of these kinds at random lines in the given range (first, last)."""
        chance = random.Random(seed)
        kinds = tuple(kinds)
        plan = [_random_fault(chance, chance.choice(kinds), lines) for _ in range(count)]
        return cls(plan)


def _random_fault(chance: random.Random, kind: str, lines: tuple[int, int]) -> Fault:
    line = chance.randint(*lines)
    length_s = {"delay": 0.5, "delay-reply": 0.5, "eeprom-stall": 0.02, "disconnect": 2.0, "door": 3.0}.get(kind, 0.0)
    if kind in SENT_KINDS or kind == "drop-reply-byte":
        # A byte somewhere in the middle of the lines, taking 20 bytes as the usual length of a line and 4 of an ok.
        per_line = 4 if kind == "drop-reply-byte" else 20
        byte = line * per_line + chance.randrange(per_line)
        return Fault(kind=kind, byte=byte, mask=1 << chance.randrange(7), length_s=length_s * chance.random())
    return Fault(kind=kind, line=line, mask=1 << chance.randrange(7), length_s=length_s * (0.5 + chance.random()))


def parse_fault(text: str) -> Fault:
    """ "kind@line=120", "kind@byte=4711", "kind@t=12.5", with ":length" seconds appended where it lasts."""
    kind, _, rest = text.partition("@")
    when, _, length = rest.partition(":")
    name, _, value = when.partition("=")
    try:
        length_s = float(length) if length else 0.0
        if name == "line":
            return Fault(kind=kind, line=int(value), length_s=length_s)
        if name == "byte":
            return Fault(kind=kind, byte=int(value), length_s=length_s)
        if name == "t":
            return Fault(kind=kind, at_s=float(value), length_s=length_s)
    except ValueError as error:
        if kind not in KINDS:
            raise
        raise ValueError(f"fault '{text}': {error}") from None
    raise ValueError(f"fault '{text}' is not understood: write kind@line=N, kind@byte=N or kind@t=SECONDS")
