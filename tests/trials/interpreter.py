"""Programs against an independent interpreter: LinuxCNC's own, run alone on the file, without a machine.

    apt-get install linuxcnc-uspace      # Debian: its command rs274

Every pass of a small lens is written in each dialect of G-code and interpreted; each must be accepted as it stands, and
the positions that the interpreter prints, with four decimals, must be those that our own reader finds. What only the
control itself has is put into LinuxCNC's words first and said: a program's name, the dwell, Okuma's work offset.
Work and machine coordinates are the same here, so that the head that is raised first stands at the safe height.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from cam.joining import join_programs
from cam.moves import SAFE_Z_MM
from cam.parts import PartLimits
from cam.passes import PAPER_PASSES, PassSpec, Stock
from cam.posts.dialects import POSTS, Dialect
from cam.posts.post import MM_PER_INCH, ProgramSetup
from cam.program import generate_parts
from cam.reading.gcode import LANGUAGES, read_parts
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array
from tests.benchmarks.pictures import bumps
from tests.benchmarks.timing import Figure

SIDE_MM = 20.0
COMMAND = "rs274"
PRINTED = 0.5e-4 + 1e-9  # mm or inches
TOOL = 3
_PLACE = re.compile(rb"STRAIGHT_(?:FEED|TRAVERSE)\((-?[\d.]+), (-?[\d.]+), (-?[\d.]+),")
_OWN_WORDS = {
    "fanuc": ((rb"^O\d+\n", b""), (rb"^G4X", b"G4P")),
    "okuma": (
        *((rb"^O\d+\r\n", b""), (rb"^G4F", b"G4P"), (rb"^G15H1", b"G54"), (rb"^G16H0", b"G53"), (rb"G56H", b"G43H")),
    ),
    "roland-nc": ((rb"^O\d+\r\n", b""),),
}


def figures() -> Iterator[Figure]:
    if shutil.which(COMMAND) is None:
        yield Figure("interpreter", 0.0, "programs", f"not done: {COMMAND} is not installed (linuxcnc-uspace)")
        return
    for dialect in POSTS:
        if dialect != "rml-1":
            yield _dialect(dialect)
    for dialect, post in POSTS.items():
        for units in ("mm", "inch") if post.change else ("inch",) if post.inches else ():
            yield _dialect(dialect, units=units, as_kept=True)


def _dialect(dialect: str, *, units: str = "mm", as_kept: bool = False) -> Figure:
    """as_kept: with a tool change, an optional stop and N words as well, where the control has them."""
    programs, lines, broken, unit_mm = 0, 0, "", MM_PER_INCH if units == "inch" else 1.0
    joined: list[bytes] = []
    post = POSTS[dialect]
    changes = as_kept and bool(post.change)
    post = post.adapt(units=units, number_every=1 if changes else None)
    setup = ProgramSetup(top_z_mm=SAFE_Z_MM, tool=TOOL if changes else 0, optional_stop=changes)
    for spec, parts in _passes(post, setup):
        ours = _positions_read(dialect, parts)
        theirs = []
        if changes:
            joined += parts
        for part in parts:
            places, error = interpreted(part, dialect)
            broken = broken or error
            theirs.append(places * unit_mm)
            programs, lines = programs + 1, lines + part.count(b"\n")
        off_mm = _deviation_mm(ours, np.vstack(theirs), allowed_mm=PRINTED * unit_mm)
        if off_mm > PRINTED * unit_mm:
            broken = broken or f"{spec.name} {spec.strategy}: a place is off by {off_mm:.5f} mm"
    if joined:
        places, error = interpreted(b"".join(join_programs(([part] for part in joined), post)), dialect)
        broken = broken or error
        off_mm = _deviation_mm(_positions_read(dialect, joined), places * unit_mm, allowed_mm=PRINTED * unit_mm)
        if off_mm > PRINTED * unit_mm:
            broken = broken or f"all in one file: a place is off by {off_mm:.5f} mm"
    said = f"{programs} programs accepted, every place as we read it, to the four decimals that are printed"
    own = "; its own words (name, dwell, offset) translated" if dialect in _OWN_WORDS else ""
    kept = f", {units}{', T M6, G43 H, M1, N, and all in one file' if changes else ''}" if as_kept else ""
    return Figure(
        f"LinuxCNC's interpreter: {dialect}{kept}", lines, "lines", f"BROKEN: {broken}" if broken else said + own
    )


def _passes(post: Dialect, raised: ProgramSetup) -> Iterator[tuple[PassSpec, list[bytes]]]:
    """Layers with ramps, rows with lifts, rows along Y in parts, and one contour path, on a small lens."""
    lens = bumps(side_mm=SIDE_MM)
    stock = Stock(width_mm=SIDE_MM, height_mm=SIDE_MM, thickness_mm=20.0, margin_mm=4.0)
    top = StockGrid.block(stock, 0.1)
    rough, semi, finish = PAPER_PASSES
    skin = lens.spline().extend(4.0).heights_mm(top.x_mm[None, :], top.y_mm[:, None]) + 0.05
    skinned = replace(top, top_mm=np.minimum(skin, top.top_mm))
    finish = replace(finish, pitch_mm=0.05)
    for spec, left, limits in (
        (rough, top, None),
        (replace(semi, link="retract", pitch_mm=0.2), skinned, None),
        (replace(finish, direction="y"), skinned, PartLimits(most_bytes=500_000)),
        (replace(finish, strategy="contour"), skinned, None),
    ):
        made = generate_parts(lens, spec, stock, stock_top=left, post=post, limits=limits, setup=raised)
        yield spec, [b"".join(pieces) for pieces in made]


def _positions_read(dialect: str, parts: list[bytes]) -> Array:
    batches = list(read_parts(([part] for part in parts), LANGUAGES[dialect]))
    places = [batches[0].points_mm[:1], *(batch.end_mm[batch.pause_s < 0] for batch in batches)]
    return np.vstack(places)


def interpreted(program: bytes, dialect: str = "linuxcnc") -> tuple[Array, str]:
    """(places (n, 3) that the interpreter goes to once all three coordinates are given, what it complains of)."""
    for own, common in _OWN_WORDS.get(dialect, ()):
        program = re.sub(own, common, program, flags=re.MULTILINE)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "program.ngc"
        file.write_bytes(program)
        tools = Path(folder) / "tools.tbl"
        tools.write_text(f"T{TOOL} P{TOOL} Z0.0 D6.0\n")
        done = subprocess.run(
            [COMMAND, "-t", str(tools), "-g", str(file)],
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
    places = np.array([[float(number) for number in found] for found in _PLACE.findall(done.stdout)]).reshape(-1, 3)
    complaint = "" if done.returncode == 0 and b"PROGRAM_END" in done.stdout else _last_words(done)
    return places[1:], complaint  # the first only lifts, from wherever it stands


def _last_words(done: subprocess.CompletedProcess[bytes]) -> str:
    lines = (done.stderr + done.stdout).decode(errors="replace").splitlines()
    return f"exit {done.returncode}: {' '.join(line.strip() for line in lines[-3:])[-200:]}"


def _deviation_mm(ours: Array, theirs: Array, *, allowed_mm: float) -> float:
    """The farthest that a place of theirs is from ours in turn; inf where one has a place that the other has not.

    What is said twice, such as a height that is reached already, counts once.
    """
    worst, k = 0.0, 0
    for place in theirs.tolist():
        ahead = max(abs(a - b) for a, b in zip(place, ours[k + 1], strict=True)) if k + 1 < len(ours) else np.inf
        here = max(abs(a - b) for a, b in zip(place, ours[k], strict=True))
        k += ahead <= allowed_mm
        worst = max(worst, min(ahead, here))
    return worst if k == len(ours) - 1 else np.inf
