"""How one try of one stage can end, as the supervisor of its process saw it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Done:
    """It has done its work: what the stage's function returned, as plain JSON values."""

    result: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Refused:
    """Something the person gave cannot be used. Trying again changes nothing. `field`: key of the spec, or ""."""

    lines: tuple[str, ...]
    field: str = ""


@dataclass(frozen=True, slots=True)
class Failed:
    """The stage itself failed: a check, the disk, out of memory, out of time. Trying again changes nothing."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Crashed:
    """Its process ended without a word: a signal, an exit, an error of the program itself. It may be tried again."""

    words: str


@dataclass(frozen=True, slots=True)
class Stopped:
    """It was told to end ("cancelled"), or its worker may no longer own the job ("fenced")."""

    reason: str


StageEnd = Done | Refused | Failed | Crashed | Stopped
