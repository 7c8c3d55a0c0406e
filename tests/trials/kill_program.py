"""A small random program with known segments, and pre-flight facts by the slow and simple way."""

from __future__ import annotations

import hashlib
import random
from pathlib import Path

from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.program import IndexEntry, ProgramIndex, piece_digest
from machines.preflight.preflight import Bounds, Preflight

Point = tuple[float, float, float]


def facts_of(path: Path, every_lines: int = 50) -> Preflight:
    """Pre-flight's result for a small program, by the slow and simple way."""
    data = path.read_bytes()
    lines = data.split(b"\n")[:-1]
    interpreter, entries, offset = Interpreter(ModalState()), [], 0
    starts: list[tuple[int, int, ModalState]] = []
    points: list[Point] = []
    for number, text in enumerate(lines, 1):
        if (number - 1) % every_lines == 0:
            starts.append((number, offset, interpreter.state))
        step = interpreter.take(text)
        if None not in step.end_mm:
            points.append(step.end_mm)  # type: ignore[arg-type]
        offset += len(text) + 1
    for one, (number, at, state) in enumerate(starts):
        end = starts[one + 1][1] if one + 1 < len(starts) else len(data)
        entries.append(IndexEntry(number, at, piece_digest(data[at:end]), state))
    least, most = tuple(map(min, zip(*points, strict=True))), tuple(map(max, zip(*points, strict=True)))
    return Preflight(
        sha256=hashlib.sha256(data).hexdigest(),
        bytes=len(data),
        lines=len(lines),
        blocks=len(lines),
        dialect="grbl",
        profile="grbl",
        bounds_mm=Bounds(least, most),  # type: ignore[arg-type]
        feeds_mm_per_min=(200.0, 1500.0),
        spindle_rpm=(12000.0, 12000.0),
        path_length_mm=1.0,
        time_s=60.0,
        ends=True,
        index=ProgramIndex(every_lines=every_lines, entries=tuple(entries), lines=len(lines), bytes=len(data)),
    )


def made_program(chance: random.Random, path: Path, segments: int) -> list[tuple[Point, Point]]:
    """A wandering cut without a point visited twice; the segments it consists of, in order."""
    x, y, z = 10.0, 10.0, -1.0
    lines = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", f"G0 X{x:g} Y{y:g}", f"G1 Z{z:g} F200"]
    cuts = [((x, y, 5.0), (x, y, z))]
    feed = "F1500"
    for number in range(segments):
        if number == segments // 2 and chance.random() < 0.5:
            lines += ["G0 Z5", f"G0 X{x + 1:g}", f"G1 Z{z:g} F200"]
            x = round(x + 1, 4)
            cuts.append(((x, y, 5.0), (x, y, z)))
            feed = "F1500"
        new = (
            round(x + chance.uniform(0.05, 0.4), 3),
            round(y + chance.uniform(-1, 1), 3),
            -round(chance.uniform(1, 2), 4),
        )
        if chance.random() < 0.05:  # a half circle
            new = (new[0], y, z)
            lines.append(f"G2X{new[0]:g}Y{new[1]:g}I{(new[0] - x) / 2:.4f}J0{feed}")
            feed = ""
            lines.append(f"G1X{new[0]:g}Y{new[1]:g}Z{new[2] - 0.1:.4f}")
            cuts.append(((x, y, z), new))
            cuts.append((new, (new[0], new[1], round(new[2] - 0.1, 4))))
            x, y, z = new[0], new[1], round(new[2] - 0.1, 4)
            continue
        word = "G1" if chance.random() < 0.1 else ""
        lines.append(f"{word}X{new[0]:g}Y{new[1]:g}Z{new[2]:g}{feed}")
        feed = ""
        cuts.append(((x, y, z), new))
        x, y, z = new
    lines += ["G0 Z5", "M5", "M2"]
    path.write_bytes("\n".join(lines).encode() + b"\n")
    return cuts
