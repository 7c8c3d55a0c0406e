"""The child process of pre-flight: reads a whole program with compiled code and writes its findings as one JSON file.

Request: {"path", "limits", "result": the file to write}, or {"path", "lift_mm", "result"} for a dry pass's program.
Result: {}, or {"refused": ...} or {"failed": "..."}.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from machines.gcode.dialects import RML
from machines.preflight.timeline import thin_out
from service.processes.child_work import answer_requests
from service.processes.kernel_cache import use_current_kernels

if TYPE_CHECKING:
    from cam.duration import DurationModel
    from machines.gcode.scan import ScanBatch
    from machines.preflight.preflight import MillLimits, Preflight

_CHUNK_BYTES = 1 << 22
_KNOTS_OF_BATCH = 64


def main() -> None:
    use_current_kernels()
    answer_requests("cm-preflight", _answer)


def _answer(request: dict[str, Any], on_share: Callable[[float], None]) -> dict[str, Any]:
    from machines.errors import ProgramRefusedError
    from machines.preflight.preflight import MillLimits

    path, result = Path(request["path"]), Path(request["result"])
    try:
        if (lift_mm := request.get("lift_mm")) is None:
            _write(result, examine(path, MillLimits.from_dict(request["limits"]), on_share))
        else:
            _write_lifted(path, lift_mm, result)
    except ProgramRefusedError as error:
        return {"refused": {"line": error.line, "text": error.text, "reason": error.reason}}
    except OSError as error:
        return {"failed": f"{error.filename or request['path']}: {error.strerror}"}
    return {}


def examine(path: Path, limits: MillLimits, on_share: Callable[[float], None]) -> Preflight:
    """Read a whole program in this process; ProgramRefusedError if the mill may not run it."""
    if limits.dialect == RML:
        return _read_rml(path, limits, on_share)
    return _read_gcode(path, limits, on_share)


def _read_gcode(path: Path, limits: MillLimits, on_share: Callable[[float], None]) -> Preflight:
    from cam.duration import DurationModel, Kinematics
    from machines.gcode import tally
    from machines.gcode.scan import ProgramScan
    from machines.gcode.text import require_plain_text
    from machines.preflight import rules
    from machines.preflight.preflight import Preflight
    from machines.preflight.way_in import read_way_in

    model = DurationModel(Kinematics.of(limits, bytes_per_s=limits.bytes_per_s))
    knots = _Knots(model)
    scan = ProgramScan(limits.dialect, limits.max_rate_mm_per_min)
    digest = hashlib.sha256()
    with ThreadPoolExecutor(1) as helper:  # one batch's time is planned while the next is read
        busy: Future[None] | None = None
        for batch in scan.read_batches(require_plain_text(_chunks(path, digest, on_share))):
            if busy is not None:
                busy.result()
            busy = helper.submit(knots.add, batch)
        if busy is not None:
            busy.result()
    events, totals = scan.events.tolist(), scan.totals.tolist()
    feeds = (totals[tally.LEAST_FEED], totals[tally.MOST_FEED]) if totals[tally.MOST_FEED] else None
    spindle = (totals[tally.LEAST_RPM], totals[tally.MOST_RPM]) if totals[tally.MOST_RPM] else None
    boxes = rules.find_boxes(scan.bounds.tolist())
    unplaced = (tally.BLIND_RELATIVE, tally.PLACE_UNKNOWN, tally.MACHINE_MOVES)
    with path.open("rb") as lines:
        way_in = read_way_in(enumerate(lines, 1), dialect=limits.dialect)
    reading = rules.Reading(
        limits=limits,
        events=events,
        boxes=boxes,
        feeds_mm_per_min=feeds,
        spindle_rpm=spindle,
        motions=int(totals[tally.MOTIONS]) + sum(events[slot][1] for slot in unplaced),
        ends=scan.state.ended,
        spindle_left_on=False,  # M2 switches it off, and the rule "end" warns of a program without it
        way_in=way_in.motions,
        last_z_mm=totals[tally.LAST_Z],
        last_machine_z_mm=totals[tally.LAST_MACHINE_Z],
        pause_s=totals[tally.LONGEST_PAUSE_S],
        path_length_mm=totals[tally.PATH_MM],
        time_s=model.seconds,
        lines=int(totals[tally.BLOCKS]),
        starved_s=model.starved_s,
    )
    return Preflight(
        sha256=digest.hexdigest(),
        bytes=scan.bytes,
        lines=scan.lines,
        blocks=int(totals[tally.BLOCKS]),
        dialect=limits.dialect,
        profile=limits.profile,
        bounds_mm=boxes.get("G54") or next(iter(boxes.values()), None),
        bounds_by_frame=boxes,
        feeds_mm_per_min=feeds,
        spindle_rpm=spindle,
        path_length_mm=totals[tally.PATH_MM],
        time_s=model.seconds,
        timeline=knots.make_timeline(),
        ends=scan.state.ended,
        mist_line=events[tally.MIST][0] if events[tally.MIST][1] else 0,
        assumed=rules.list_assumed_modes(events),
        findings=rules.judge_program(reading),
        index=scan.index,
    )


def _write_lifted(path: Path, lift_mm: float, target: Path) -> None:
    from machines.gcode.lift import lift_program

    with path.open("rb") as source, target.open("wb") as file:
        file.writelines(line + b"\n" for line in lift_program(source, lift_mm))


class _Knots:
    """Gathers when lines are executed, from the duration model, batch by batch."""

    def __init__(self, model: DurationModel) -> None:
        self._model = model
        self._lines: list[int] = []  # of blocks whose end is not certain yet
        self._found: list[tuple[int, float]] = []

    def add(self, batch: ScanBatch) -> None:
        from cam.duration import is_block

        self._lines += batch.line[is_block(batch)].tolist()
        self._take(self._model.add_batch(batch).tolist())

    def make_timeline(self) -> tuple[tuple[int, float], ...]:
        self._take(self._model.list_waiting_s().tolist())
        return thin_out(self._found)

    def _take(self, ends_s: list[float]) -> None:
        self._found += thin_out(list(zip(self._lines, ends_s, strict=False)), _KNOTS_OF_BATCH)
        del self._lines[: len(ends_s)]


def _read_rml(path: Path, limits: MillLimits, on_share: Callable[[float], None]) -> Preflight:
    from machines.gcode.program import TextIndex
    from machines.gcode.text import require_plain_text
    from machines.preflight import rules
    from machines.preflight.preflight import Bounds, Preflight
    from machines.profile import MachineProfile
    from machines.roland.rml import check_rml

    digest, index = hashlib.sha256(), TextIndex(limits.dialect)
    profile = MachineProfile(
        name=limits.profile,
        dialect=limits.dialect,
        travel_mm=limits.travel_mm,
        max_rate_mm_per_min=limits.max_rate_mm_per_min,
        acceleration_mm_per_s2=limits.acceleration_mm_per_s2,
        step_mm=0.01,
        junction_deviation_mm=limits.junction_deviation_mm,
        planner_blocks=limits.planner_blocks,
        lines_per_s=limits.lines_per_s,
        spindle_rpm=limits.spindle_rpm,
        safe_z_mm=limits.safe_z_mm,
    )
    text = require_plain_text(_chunks(path, digest, on_share), lone_returns=True)
    facts = check_rml(index.cut_into_pieces(text), profile)
    box = Bounds(*facts.bounds_mm) if facts.bounds_mm else None
    reading = rules.Reading(
        limits=limits,
        boxes={},
        feeds_mm_per_min=facts.feeds_mm_per_min,
        spindle_rpm=facts.spindle_rpm,
        motions=facts.motions,
        ends=facts.ends,
        spindle_left_on=not facts.ends,
        way_in=facts.way_in,
        last_z_mm=facts.last_z_mm,
        last_machine_z_mm=inf,
        pause_s=0.0,
        path_length_mm=facts.path_length_mm,
        time_s=facts.time_s,
    )
    return Preflight(
        sha256=digest.hexdigest(),
        bytes=facts.bytes,
        lines=index.index.lines,
        blocks=index.blocks,
        dialect=limits.dialect,
        profile=limits.profile,
        bounds_mm=box,
        bounds_by_frame={"user": box} if box else {},
        feeds_mm_per_min=facts.feeds_mm_per_min,
        spindle_rpm=facts.spindle_rpm,
        path_length_mm=facts.path_length_mm,
        time_s=facts.time_s,
        ends=facts.ends,
        findings=rules.judge_program(reading),
        index=index.index,
    )


def _chunks(path: Path, digest: hashlib._Hash, on_share: Callable[[float], None]) -> Iterator[bytes]:
    """Yield the file in pieces; hash them and report the share that has been read."""
    with path.open("rb", buffering=0) as file:
        size, done = max(1, os.fstat(file.fileno()).st_size), 0
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
            done += len(chunk)
            yield chunk
            on_share(min(1.0, done / size))


def _write(target: Path, found: Preflight) -> None:
    """Write the file whole or not at all."""
    staging = target.with_name(f".{target.name}.{os.getpid()}")
    try:
        staging.write_text(found.to_json(), encoding="utf-8")
        staging.replace(target)
    finally:
        staging.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
