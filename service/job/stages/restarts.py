"""The lines at which a checked program may be entered again after a break, for report and setup sheet."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import Any

from cam.checking.restarts import RestartFinder, choose_points
from cam.passes import PassSpec
from cam.reading.gcode import LANGUAGES, read_parts
from machines.preflight.preflight import Preflight
from machines.preflight.timeline import compute_time_at_s
from machines.profile import MachineProfile
from service.job.files import read_chunks


def list_restarts(path: Path, found: Preflight, spec: PassSpec, machine: MachineProfile) -> list[dict[str, Any]]:
    """Return rows, in the order of their lines, of one program of a pass: line, its text, place of the tool, feed and
    speed in force, and the time from the start; none of RML-1, whose mills cannot be started in the middle.

    found : the program's pre-flight
    """
    language = LANGUAGES[machine.dialect]
    if language.kind == "rml":
        return []
    finder = RestartFinder(safe_z_mm=machine.safe_z_mm, axis=1 if spec.direction == "y" else 0)
    for batch in read_parts([read_chunks(path)], language):
        finder.add(batch)

    def time_at_s(line: int) -> float:
        return compute_time_at_s(found.timeline, line, lines=found.lines, time_s=found.time_s)

    chosen = choose_points(finder.list_points(), time_at_s, found.time_s)
    texts, read = [], 0
    with path.open("rb") as lines:
        for point, _ in chosen:
            texts.append(next(islice(lines, point.line - 1 - read, None)).strip().decode("ascii"))
            read = point.line
    return [
        {
            "line": point.line,
            "text": text,
            "kind": point.kind,
            "at_mm": [round(value, 5) for value in point.at_mm],
            "is_rapid": point.is_rapid,
            "feed_mm_per_min": point.feed_mm_per_min,
            "spindle_rpm": point.spindle_rpm,
            "time_s": round(at_s, 1),
        }
        for (point, at_s), text in zip(chosen, texts, strict=True)
    ]
