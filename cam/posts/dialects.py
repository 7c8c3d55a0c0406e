"""Every dialect in which programs can be written, by its name in machine profiles, and its abilities.

GRBL 1.1, grblHAL and FluidNC read G-code, and so do controls that once read ISO code from a tape: LinuxCNC, Fanuc-like,
Okuma OSP and Roland NC. RML-1 is in `cam.posts.post`. Where a shop changes tools by program, T and M6 come first, and
the length (G43 H, Okuma's G56 H) with the first Z of the work frame: alone it moves Z on some controls. Otherwise
programs contain no tool length: Z0 is set with that tool, and the active tool offset stays. G40 and G80 cancel modes
that an earlier program may have left on. Where the least input is 0.001 mm (0.0001 inch), positions have three (four)
decimals and always a point: without one, 5 means 0.005 mm. On machining centres M8 is coolant everywhere; the builder
chooses the word for air or mist, so we do not guess one.

Plain data without arrays; `cam.posts.writers` writes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import reduce

from cam.posts.post import RML, Post, ProgramSetup, RmlPost
from phrases.phrase import Phrase

# No `%`, no tool change, no tool compensation. The length set by a tool-length probe (G43.1) stays active.
GRBL = Post(
    name="grbl",
    suffix=".nc",
    start=("G21G90G94G17{offset}",),
    zero="zero: {offset}, with G92 and tool length G43.1 as they were when it was set",
    spin=("M3S{rpm}", "G4P{dwell_s}"),
    end=("M5", "M2"),
    inches=True,
    coolant={"air": "M8", "mist": "M7", "flood": "M8"},  # stock GRBL has one output, M8, and M7 only where built in
)
GRBLHAL = replace(GRBL, name="grblhal")
FLUIDNC = replace(GRBL, name="fluidnc")

# G64 P: corners rounded by 1 µm at most unless a job says otherwise; Q0: no vertex left out because it lies near a
# straight line. G61.1: an exact stop.
LINUXCNC = Post(
    name="linuxcnc",
    suffix=".ngc",
    start=("G21G90G94G17G40G80{offset}", "{blend}"),
    zero="zero: {offset}, with G92 and tool length G43 as they were when it was set",
    spin=("M3S{rpm}", "G4P{dwell_s}"),
    blend=("G64P{tolerance}Q0", "G61.1"),
    coolant={"air": "M7", "mist": "M7", "flood": "M8"},
    change=("T{tool}M6",),
    length="G43H{tool}",
    stop="M1",
    inches=True,
    end=("M5", "M2"),
)
# The dwell by X, in seconds: P is milliseconds on most of these and seconds on some.
FANUC = Post(
    name="fanuc",
    suffix=".nc",
    tape=("%", "O{number:04d}"),
    start=("G21G90G94G17G40G80{offset}",),
    zero="zero: {offset}, with G52, G92 and G43 as they were when it was set",
    spin=("S{rpm}M3", "G4X{dwell_s}"),
    change=("T{tool}M6",),
    length="G43H{tool}",
    stop="M1",
    inches=True,
    coolant={"flood": "M8"},
    high_precision=True,
    end=("M5", "M30", "%"),
    capitals=True,
    xy_decimals=3,
    z_decimals=3,
    least_decimals=1,
    feed_decimals=0,
    number_every=100,
)
# G15 H1 to H6 are what G54 to G59 are elsewhere, G16 H0 is G53: machine coordinates for one block. The dwell is by F.
# That G16 H0 leaves the length of G56 out, as G53 does elsewhere, is a guess: Autodesk's Okuma posts retract by it with
# G56 active (newer ones to Z=VPSLZ, the soft limit); no manual that says so was found. The setup sheet asks to try it.
OKUMA = Post(
    name="okuma",
    suffix=".min",
    tape=("%", "O{number:04d}"),
    start=("G21G90G94G17G40G80", "G15H{offset_number}"),
    offset_name="G15 H{offset_number}",
    zero="zero: G15 H{offset_number}, with tool length G56 as it was when it was set",
    top="G16H0G0Z{top}",
    guesses_top=True,
    spin=("S{rpm}M3", "G4F{dwell_s}"),
    change=("T{tool}M6",),
    length="G56H{tool}",
    stop="M1",
    inches=True,
    coolant={"flood": "M8"},
    end=("M5", "M2", "%"),
    capitals=True,
    xy_decimals=3,
    z_decimals=3,
    least_decimals=1,
    feed_decimals=1,
    number_every=100,
    line_end="\r\n",
)
# It faults on a cut before S and M03. P of G04 has no point: if it were milliseconds, the dwell would only be short.
ROLAND_NC = Post(
    name="roland-nc",
    suffix=".nc",
    tape=("%", "O{number:08d}"),
    start=("G21G90G17G40G80{offset}", "S{rpm}M03"),
    zero="zero: {offset}, with EXOFS as it was when it was set",
    lift="G00Z{safe_z}",
    top="G53G00Z{top}",
    spin=("G04P{whole_dwell_s}",),
    faster=("S{rpm}M03", "G04P{whole_dwell_s}"),
    end=("M05", "M02", "%"),
    rapid="G00",
    cut="G01",
    capitals=True,
    xy_decimals=3,
    z_decimals=3,
    least_decimals=1,
    feed_decimals=1,
    line_end="\r\n",
)

Dialect = Post | RmlPost

_ALL: tuple[Dialect, ...] = (GRBL, GRBLHAL, FLUIDNC, LINUXCNC, FANUC, OKUMA, ROLAND_NC, RML)
POSTS: dict[str, Dialect] = {post.name: post for post in _ALL}


def find_unsupported(
    dialect: str,
    setup: ProgramSetup,
    *,
    units: str = "mm",
    number_every: int | None = None,
    one_program: bool = False,
) -> Iterator[tuple[str, str, Phrase]]:
    """Yield (field, value in words, what is allowed) for every request that a control of this dialect cannot fulfil."""
    post = POSTS[dialect]
    if setup.coolant != "none" and setup.coolant not in post.coolant:
        names = [f"'{name}'" for name in ("none", *post.coolant)]
        able = reduce(lambda names, name: Phrase("{names} or {name}", names=names, name=name), names)
        yield (
            "coolant",
            f"'{setup.coolant}'",
            Phrase("{allowed} in dialect '{dialect}'", allowed=able, dialect=dialect),
        )
    if setup.blend_tolerance_mm is not None and not post.blends:
        able = _list_all(other.name for other in _ALL if other.blends)
        yield (
            "blend_tolerance_mm",
            f"{setup.blend_tolerance_mm:g}",
            Phrase(
                "left out in dialect '{dialect}', which has no word for a tolerance; {able} has one",
                dialect=dialect,
                able=able,
            ),
        )
    if setup.work_offset != 1 and not post.offsets:
        allowed = Phrase("1 in dialect '{dialect}', whose zero is set at the mill", dialect=dialect)
        yield "work_offset", f"{setup.work_offset}", allowed
    if setup.high_precision != "none" and not post.high_precision:
        able = _list_all(f"'{other.name}'" for other in _ALL if other.high_precision)
        allowed = Phrase("'none' in dialect '{dialect}'; {able} has such modes", dialect=dialect, able=able)
        yield "high_precision", f"'{setup.high_precision}'", allowed
    for field, value, is_able, has in (
        ("tool_change", "true" if setup.tool else "", post.change, lambda one: bool(one.change)),
        ("one_program", "true" if one_program else "", post.change, lambda one: bool(one.change)),
        ("optional_stop", "true" if setup.optional_stop else "", post.stop, lambda one: bool(one.stop)),
        ("units", "'inch'" if units == "inch" else "", post.inches, lambda one: one.inches),
        ("number_every", f"{number_every}" if number_every else "", post.stop, lambda one: bool(one.stop)),
    ):
        if value and not is_able:
            able = _name_those(has)
            yield field, value, Phrase("left out in dialect '{dialect}'; {able} can do it", dialect=dialect, able=able)


def _name_those(has: Callable[[Dialect], bool]) -> str:
    return _list_all(f"'{other.name}'" for other in _ALL if has(other))


def _list_all(names: Iterable[str]) -> str:
    return reduce(lambda names, name: Phrase("{names} and {name}", names=names, name=name), names)
