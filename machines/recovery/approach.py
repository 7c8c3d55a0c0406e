"""The blocks that bring the tool from where it stands to where the program is entered: up, across, down."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import floor

from machines.errors import MachineError
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.preflight.limits import work_zero_mm
from machines.preflight.preflight import Preflight
from machines.recovery.entry import EntryPoint
from machines.recovery.plan_model import Present, Reentry
from phrases.phrase import Phrase


def height_mm(present: Present, wcs: str) -> float | None:
    """Return Z of the tool in the frame the program is entered in, which need not be the one the controller is
    in now.
    """
    status, zero_mm = present.status, work_zero_mm(present.offsets or {}, wcs)
    if status.machine_mm is None or zero_mm is None:
        return status.work_mm[2] if status.work_mm is not None else None
    return status.machine_mm[2] - zero_mm[2]


def travel_height_mm(present: Present, wcs: str, facts: Preflight, reentry: Reentry) -> float:
    """Work Z at which the tool goes across: the safe height, or as high as the program goes, where that is higher.

    Where the mill does not reach the safe height: as high as it gets, which is not below the program's own height.
    """
    highest = facts.bounds_mm.most_mm[2] if facts.bounds_mm is not None else None
    wanted_mm = max(reentry.safe_z_mm, highest if highest is not None else reentry.safe_z_mm)
    zero_mm = work_zero_mm(present.offsets or {}, wcs)
    if present.top_mm is None or zero_mm is None or highest is None:
        return wanted_mm
    return max(min(wanted_mm, floor(1000.0 * (present.top_mm - zero_mm[2])) / 1000.0), highest)


def plan_lead_in(
    entry: EntryPoint, tool_z_mm: float, facts: Preflight, safe_mm: float, reentry: Reentry
) -> tuple[str, ...]:
    """Return blocks to the entry point: always up before across, always across before down."""
    state = entry.state
    blocks = [f"G21 G90 G94 G17 {state.wcs}"]
    turns = state.spindle != "M5" and entry.position_mm is not None
    if turns:
        blocks += [f"{state.spindle} S{state.spindle_rpm:g}", f"G4 P{reentry.spin_up_s:g}"]
    if tool_z_mm < safe_mm:
        blocks.append(f"G0 Z{_mm(safe_mm)}")
    if entry.position_mm is None:
        return (*blocks, "M5")
    x, y, z = entry.position_mm
    blocks.append(f"G0 X{_mm(x)} Y{_mm(y)}")
    if tool_z_mm > safe_mm:
        blocks.append(f"G0 Z{_mm(safe_mm)}")
    blocks += [word for word in state.coolant.split() if word != "M9"]
    slowest = facts.feeds_mm_per_min[0] if facts.feeds_mm_per_min else reentry.plunge_mm_per_min
    blocks.append(f"G1 Z{_mm(z)} F{min(slowest, reentry.plunge_mm_per_min):g}")
    if state.feed_mm_per_min is not None and state.feed_mode == "G94":
        blocks.append(f"F{state.feed_mm_per_min:g}")
    restored = [
        word for word, now in ((state.units, "G21"), (state.plane, "G17"), (state.feed_mode, "G94")) if word != now
    ]
    return (*blocks, " ".join(restored)) if restored else tuple(blocks)


def _mm(value: float) -> str:
    return f"{value:.5f}".rstrip("0").rstrip(".") if abs(value) >= 5e-6 else "0"


def find_unreadable(blocks: Sequence[str]) -> Iterator[Phrase]:
    """Read our own blocks as a program is read: what it refuses is never sent."""
    interpreter = Interpreter(ModalState())
    for block in blocks:
        try:
            interpreter.take(block.encode("ascii"))
        except MachineError as error:
            yield Phrase("re-entry block '{block}': {error}", block=block, error=str(error))
            return
