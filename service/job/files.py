"""The folder of a job: names, atomic writes, and the staging folder from which a finished job is put in place.

Theory of operation: a command works in a hidden folder, inside the output folder where there is one (it may be a mount
of its own, into which nothing can be renamed from outside), else beside its future place. Only when all has succeeded,
or the lens at least (`pipeline.make`), are the files renamed into the output folder, report.json last; failure or
Ctrl-C removes the hidden folder and nothing else. A file that is renamed over another is complete at every moment.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
import signal
import threading
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

from phrases.phrase import Phrase
from service.errors import DiskError, InputError, sentence_of_os_error
from service.job.report.pictures import PICTURES, list_pictures
from service.processes.files import open_whole

SPEC, REPORT, REPORT_PAGE, SETUP_PDF = "spec.json", "report.json", "report.html", "setup-sheet.pdf"
HEIGHTFIELD, MAP, SOLID = "heightfield.npz", "map.npz", "lens.stl"
STEP, PACKED_STEP = "lens.step", "lens.stpZ"  # one of them, where stock.step_file asks for it
TARGET_PICTURE, PREPARED = "target.png", "prepared.png"
LENS_FILES = (HEIGHTFIELD, MAP, SOLID, STEP, PACKED_STEP, *list_pictures("lens"))
LIGHT_FILES = tuple(list_pictures("light"))
AS_FINISHED, COMPARED_FINISHED = "caustic-as-finished.png", "comparison-as-finished.png"
FINISH_TOLERANCE = "finish-tolerance.png"
# Programs around the passes, by the name in their file:
FACE, WITNESS, CUT_OUT = "face", "witness", "cut-out"
AFTER_PASSES = (WITNESS, CUT_OUT)
TOOLPATH, PLAN, ENVELOPE = "toolpath.png", "plan.png", "envelope.png"
SURFACE = "surface.bin"
THUMBNAIL = "thumbnail.png"  # of the target, until there is a picture of the finished wall
THUMBNAIL_AS_MILLED, THUMBNAIL_AS_FINISHED = "thumbnail-as-milled.png", "thumbnail-as-finished.png"
THUMBNAILS = (THUMBNAIL_AS_FINISHED, THUMBNAIL_AS_MILLED, THUMBNAIL)  # the first existing one represents the job
LIGHT, LIGHT_AS_MILLED, LIGHT_AS_FINISHED = "light.bin", "light-as-milled.bin", "light-as-finished.bin"
STOPPING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
ONE_PROGRAM = "all-passes"  # the name, without the dialect's suffix, of all programs in one
_PROGRAM = re.compile(r"pass-\d+-[a-z0-9-]+\.[a-z0-9]+")
_ONE_PROGRAM = re.compile(ONE_PROGRAM + r"\.[a-z0-9]+")
COUPON_FILES = ("coupon.png", "coupon-as-finished.png", "coupon.txt", "coupon.npz")
COUPON_FIT_FILES = ("coupon-fit.json", "coupon-fit.png", "coupon-fit.toml")
COUPON_ARCHIVE = "coupon.zip"
_KNOWN = {
    *(SPEC, REPORT, REPORT_PAGE, SETUP_PDF, HEIGHTFIELD, MAP, SOLID, STEP, PACKED_STEP),
    *(picture.name for picture in PICTURES), *COUPON_FILES, *COUPON_FIT_FILES,
}  # fmt: skip
_DRAWINGS = frozenset((SURFACE, *THUMBNAILS, LIGHT, LIGHT_AS_MILLED, LIGHT_AS_FINISHED))
_DRAWING = re.compile(r"pass-\d+\.path|report-[a-z]+\.html")
_STAGING = ".part"
_CHUNK_BYTES = 1 << 22
_ALIGN = 8
_REPORT_TABLES = ("source", "image", "optics", "timings_s", "warnings_by_part", "phrases", "versions")
_PASS_KEYS = {"file", "lines", "path_length_mm", "time_s", "entries", "bounds"}  # those that later commands read


@dataclass(frozen=True, slots=True, kw_only=True)
class WrittenProgram:
    """A written program: file name, hash, lines and bytes."""

    file: str
    sha256: str
    lines: int
    bytes: int


def program_name(number: int, name: str, suffix: str, part: int | None = None) -> str:
    """Return pass-1-rough.nc: number from 1, the pass's name, the dialect's suffix. Part: pass-1-rough-02.nc."""
    return f"pass-{number}-{name}{suffix}" if part is None else f"pass-{number}-{name}-{part:02d}{suffix}"


def stock_name(number: int) -> str:
    """Return the file that holds the stock that pass `number` has left; 0: the facing before all of them."""
    return f".stock-{number}.npz"


FACED_STOCK, LAST_STOCK = stock_name(0), ".stock-last.npz"


def programs_in_order(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of all programs in running order: face, passes, witness marks, cut-out."""
    around = report.get("around", {})
    first, last = ([around[name] for name in names if name in around] for names in ((FACE,), AFTER_PASSES))
    return [*first, *report.get("passes", ()), *last]


def path_name(number: int) -> str:
    """Return the file from which the operator page draws a pass."""
    return f"pass-{number}.path"


def page_in(language: str) -> str:
    """Return the name of the setup sheet in another language, for links on the operator page."""
    return f"report-{language}.html"


def files_of_pass(row: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return (name, sha256) of the programs of one row of report `passes`, in the order in which they are run."""
    return [(part["file"], part["sha256"]) for part in row.get("parts") or [row]]


def names_of_pass(row: Mapping[str, Any]) -> list[str]:
    """Return the names of the programs of one row of report `passes`."""
    return [part["file"] for part in row.get("parts") or [row]]


def is_program(name: str) -> bool:
    return _PROGRAM.fullmatch(name) is not None


def is_one_program(name: str) -> bool:
    """Return whether the file holds all programs of a job, one after the other."""
    return _ONE_PROGRAM.fullmatch(name) is not None


def program_order(name: str) -> tuple[int, int, str]:
    """Return the key that sorts programs into the order in which they are run."""
    pass_number, _, rest = name.removeprefix("pass-").partition("-")
    return int(pass_number), len(rest), rest  # part numbers above 99 have three digits


def is_drawing(name: str) -> bool:
    """Return whether only the operator page reads the file, so that it is not needed in a folder."""
    return name in _DRAWINGS or _DRAWING.fullmatch(name) is not None


def is_known(name: str) -> bool:
    """Return whether this program writes a file of this name into a job's folder."""
    return name in _KNOWN or is_program(name) or is_one_program(name) or is_drawing(name)


def is_job_folder(folder: Path) -> bool:
    """Return whether an earlier command of this program filled the folder."""
    try:
        report = read_report(folder)
    except (OSError, InputError):
        return False
    return (folder / SPEC).is_file() and "causticmill" in report.get("versions", {})


def require_usable_output(folder: Path, *, force: bool) -> None:
    """Refuse an output folder that holds something else, before any work is done. `force` lets files be added to it."""
    for path in (folder, *folder.absolute().parents):
        if path.exists() and not path.is_dir():
            raise InputError(f"--output: {path} is a file; allowed: a new or empty folder, or an earlier job's")
        if path.is_symlink() and not path.exists():
            raise InputError(f"--output: {path} is a link to a place that does not exist; allowed: an existing folder")
    if not folder.exists() or force or is_job_folder(folder) or _is_cut_short(folder):
        return
    if set(folder.absolute().iterdir()) - _find_staging_folders(folder):
        raise InputError(
            f"--output: {folder} holds other files; allowed: a new or empty folder, an earlier job's, or --force"
        )


def _is_cut_short(folder: Path) -> bool:
    """Return whether a job was killed while it was put in place: its files and no other, without the report."""
    names = {path.name for path in set(folder.absolute().iterdir()) - _find_staging_folders(folder)}
    return SPEC in names and REPORT not in names and all(map(is_known, names))


def zip_entry(name: str) -> zipfile.ZipInfo:
    """Return a file in an archive that depends on its files alone: the earliest date that zip knows, readable by
    all.
    """
    entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
    entry.external_attr = 0o644 << 16
    return entry


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file so that `path` holds the old content or all of the new, on disk."""
    with atomic_file(path) as file:
        file.write(data)


def write_json(path: Path, data: object) -> None:
    write_bytes(path, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


def make_header_line(facts: Mapping[str, Any]) -> bytes:
    """Return the first line of a file for the page; spaces make its length a multiple of 8, for the arrays behind."""
    text = json.dumps(facts, separators=(",", ":"), allow_nan=False).encode()
    return text + b" " * (-(len(text) + 1) % _ALIGN) + b"\n"


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that takes its name when the block ends well, and is removed when it does not.

    Raises DiskError, one line, if the disk refuses.
    """
    try:
        with open_whole(path) as file:
            yield file
    except OSError as error:
        error.filename = None  # the hidden name means nothing to the person
        raise DiskError(sentence_of_os_error(error, doing=Phrase("cannot write {name}", name=path.name))) from error


def write_program(path: Path, chunks: Iterable[bytes]) -> WrittenProgram:
    """Stream a program to disk, counting and hashing it. The file gets its name only when the program is complete."""
    digest, lines, size = hashlib.sha256(), 0, 0
    with atomic_file(path) as file:
        for chunk in chunks:
            file.write(chunk)
            digest.update(chunk)
            lines += chunk.count(b"\n")
            size += len(chunk)
    return WrittenProgram(file=path.name, sha256=digest.hexdigest(), lines=lines, bytes=size)


def read_chunks(path: Path) -> Iterator[bytes]:
    """Yield the bytes of a file, a few megabytes at a time."""
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            yield chunk


def read_report(folder: Path) -> dict[str, Any]:
    """Read report.json of a folder; empty when there is none. InputError if it is damaged."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError) as error:
        words = Phrase("{path}: not valid JSON ({cause})", path=folder / REPORT, cause=str(error)[:100])
        raise InputError(words) from None
    if not _is_report(report):
        words = Phrase(
            "{path}: not a report of this program; `causticmill make` writes a new one", path=folder / REPORT
        )
        raise InputError(words)
    return dict(report)


def _is_report(report: object) -> bool:
    if not isinstance(report, dict) or not all(isinstance(report.get(key, {}), dict) for key in _REPORT_TABLES):
        return False
    rows = report.get("passes", [])
    return isinstance(rows, list) and all(isinstance(row, dict) and set(row) >= _PASS_KEYS for row in rows)


@contextlib.contextmanager
def stage_folder(output: Path, *, keep: Iterable[str] = ()) -> Iterator[Path]:
    """Open a hidden folder to work in, put in place of `output` when the block ends well.

    keep : names of files of `output` that the job builds on; they appear in the hidden folder (as links).
    The earlier job's other files disappear when the new ones are put in place; foreign files stay. While one process
    works on an output, a second one is refused: their lens and programs would mix.
    """
    output = output.absolute()
    made = _make_parents(output.parent)
    home = output if output.is_dir() else output.parent
    staging = home / f".{output.name}.{secrets.token_hex(4)}{_STAGING}"
    try:
        staging.mkdir()
        with _lock_folder(staging):
            _clear_abandoned(output, mine=staging)
            for name in set(keep):
                if (output / name).is_file():
                    _link(output / name, staging / name)
            yield staging
            with _defer_signals():
                _put_in_place(staging, output)
    except BaseException:
        with _defer_signals():
            shutil.rmtree(staging, ignore_errors=True)
            for folder in reversed(made):
                with contextlib.suppress(OSError):
                    folder.rmdir()
        raise


def _put_in_place(staging: Path, output: Path) -> None:
    if not output.exists():
        staging.rename(output)
        return
    (output / REPORT).unlink(missing_ok=True)  # from here until the end this is not a finished job
    new = sorted(staging.iterdir(), key=lambda path: path.name == REPORT)
    names = {path.name for path in new}
    for old in output.iterdir():
        if old.name not in names and is_known(old.name):
            old.unlink()
    for path in new:
        path.replace(output / path.name)
        path.unlink(missing_ok=True)  # renaming one link of a file onto another does nothing
    staging.rmdir()


def _make_parents(folder: Path) -> list[Path]:
    """Create missing parents; returns those made, outermost first."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    return missing[::-1]


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)


@contextlib.contextmanager
def _lock_folder(folder: Path) -> Iterator[None]:
    """Hold a lock on the folder for as long as this process works in it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network file systems have no locks
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


def _clear_abandoned(output: Path, *, mine: Path) -> None:
    """Remove staging folders of this output whose process was killed, i.e. those without a lock. InputError if another
    process holds a lock.
    """
    for folder in _find_staging_folders(output) - {mine}:
        with contextlib.suppress(OSError):
            descriptor = os.open(folder, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder)
            except BlockingIOError:
                raise InputError(
                    f"--output: another causticmill is working on {output}; allowed: another folder, or wait for it"
                ) from None
            finally:
                os.close(descriptor)


def _find_staging_folders(output: Path) -> set[Path]:
    """Find hidden folders of jobs for this output, running or killed: beside it and in it."""
    output = output.absolute()
    name = re.compile(rf"\.{re.escape(output.name)}\.[0-9a-f]{{8}}{re.escape(_STAGING)}")
    places = [place for place in (output.parent, output) if place.is_dir()]
    return {path for place in places for path in place.iterdir() if name.fullmatch(path.name) and path.is_dir()}


@contextlib.contextmanager
def _defer_signals() -> Iterator[None]:
    """Ignore stop signals in this short block, which ends the job anyway (main thread only)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # not SIG_IGN: Python complains of a signal that came just before
    before = {kind: signal.signal(kind, lambda *_: None) for kind in STOPPING_SIGNALS}
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


def plain(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same figures with null in place of infinite or unknown values, which JSON cannot express."""
    return {key: _value(value) for key, value in record.items()}


def _value(value: Any) -> Any:
    if isinstance(value, Mapping):
        return plain(value)
    if isinstance(value, list | tuple):
        return [_value(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def table(value: Any) -> Mapping[str, Any]:
    """Return a part of the report or of the spec; an empty one if there is none."""
    return value if isinstance(value, Mapping) else {}


def list_programs(spec: Mapping[str, Any], report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return a row for each program, in the order in which they are run: the spec's values and over them the report's.

    number    : of the pass, as in its file's name: 0 for the facing, from 1 for the passes, then what comes after them
    is_around : not one of the lens
    is_made   : written and checked; the others are what the spec asks for
    """
    return [
        {
            **({"tool": "flat"} if is_around else {}),
            **wanted,
            **table(made.get("settings")),
            **made,
            "number": number,
            "is_around": is_around,
            "is_made": bool(made),
        }
        for number, is_around, wanted, made in _pair(spec, report)
    ]


def _pair(
    spec: Mapping[str, Any], report: Mapping[str, Any]
) -> Iterator[tuple[int, bool, Mapping[str, Any], Mapping[str, Any]]]:
    """Yield (number, is_around, row of the spec, row of the report), either of them empty where there is none."""
    wanted, made = _rows(spec.get("passes")), _rows(report.get("passes"))
    stock, around = table(spec.get("stock")), table(report.get("around"))
    if FACE in around or stock.get("face"):
        yield 0, True, table(stock.get("face")), table(around.get(FACE))
    count = max(len(wanted), len(made))
    for at in range(count):
        yield at + 1, False, wanted[at] if at < len(wanted) else {}, made[at] if at < len(made) else {}
    number = count
    for name in AFTER_PASSES:
        row, asked = table(around.get(name)), table(stock.get("cut_out")) if name == CUT_OUT else {}
        if row or asked:
            # where no witness marks could be made, no program has their number
            file = str(row.get("file"))
            number = program_order(file)[0] if is_program(file) else number + 1
            yield number, True, asked, row


def _rows(value: Any) -> Sequence[Mapping[str, Any]]:
    return [table(row) for row in value] if isinstance(value, Sequence) and not isinstance(value, str) else []
