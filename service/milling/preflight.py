"""Pre-flight of a program: a child process reads it whole before it may run; the result is stored by its content.

The compiled scanner runs in the child, so that the streaming process stays small. A result is stored under the sha256
of the program and of everything against which it was checked; a quick key (size, time, inode) saves hashing a program
that has not been touched. That key proves nothing: while streaming, each piece is hashed again before it is sent.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from machines.errors import MachineError, ProgramRefusedError
from machines.gcode.lift import require_liftable
from machines.grbl.settings import ControllerSettings
from machines.preflight.preflight import (
    Finding,
    MillLimits,
    Preflight,
    limits_of,
    placement_problems,
    warn_at_present_zero,
)
from machines.profile import MachineProfile
from phrases.phrase import Phrase
from service.errors import sentence_of_os_error
from service.processes.child import Child, ChildError
from service.processes.files import forget_oldest, make_private
from service.processes.source_tree import hash_files

_ROOT = Path(__file__).parents[2]
_KEPT_BYTES = 200_000_000  # of results and quick keys


class PreflightError(MachineError):
    """Pre-flight itself did not work: the file cannot be read, or the child process failed."""


def default_cache() -> Path:
    """Return $XDG_CACHE_HOME/causticmill/preflight."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "causticmill" / "preflight"


def run_preflight(
    path: Path,
    profile: MachineProfile,
    *,
    settings: ControllerSettings | None = None,
    dry_pass: bool = False,
    cache: Path | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Preflight:
    """Return the facts about the program at `path` before it may run on this mill.

    settings : the controller's own figures take the place of the profile's; where it reports its offsets, warnings say
               how the program would exceed the travel at the present work zero (never kept: a zero moves)
    dry_pass : the program is one of `write_dry_pass`
    ProgramRefusedError names line, text and way out; PreflightError if the file cannot be read at all.
    """
    folder = cache or default_cache()
    limits = limits_of(profile, settings, dry_pass=dry_pass)
    path = path.absolute()
    try:
        make_private(folder)
        stat = path.stat()
        if not path.is_file():
            raise PreflightError(Phrase("{path}: not a file", path=path))
        quick = folder / f"quick-{_digest([stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns])}.txt"
        held_against = _digest([limits.to_dict(), _sources()])
        found = _load_kept(folder, held_against, _read_note(quick))
        if found is None and list(folder.glob(f"{held_against}-{stat.st_size}-*.json")):
            found = _load_kept(folder, held_against, f"{stat.st_size}-{_sha256(path)}")
        if found is None:
            found = _compute(path, limits, folder, held_against, on_progress)
            forget_oldest(folder, _KEPT_BYTES)
        _note(quick, f"{found.bytes}-{found.sha256}")
    except OSError as error:
        words = Phrase("{reason}", reason=sentence_of_os_error(error, doing="pre-flight"))
        raise PreflightError(words) from None
    problems = placement_problems(found, settings) if settings else ()
    placed = (Finding("placement", False, warn_at_present_zero(problem)) for problem in problems)
    return replace(found, findings=(*found.findings, *placed))


def _compute(
    path: Path, limits: MillLimits, folder: Path, held_against: str, on_progress: Callable[[float], None] | None
) -> Preflight:
    """Run the child; its result gets the name of its content."""
    staging = folder / f".new-{os.getpid()}-{_digest([str(path), held_against])}.json"
    try:
        _ask_child(path, {"limits": limits.to_dict(), "result": str(staging)}, on_progress)
        text = staging.read_text(encoding="utf-8")
        found = Preflight.from_json(text)
        staging.replace(folder / f"{held_against}-{found.bytes}-{found.sha256}.json")
        return found
    finally:
        staging.unlink(missing_ok=True)


def write_dry_pass(path: Path, profile: MachineProfile, lift_mm: float, target: Path) -> None:
    """Write the program raised by `lift_mm`, with spindle and coolant off. Errors as of `run_preflight`."""
    require_liftable(profile.dialect)
    _ask_child(path, {"lift_mm": lift_mm, "result": str(target)})


def _ask_child(path: Path, request: dict[str, Any], on_progress: Callable[[float], None] | None = None) -> None:
    """Let a child process do its work on the program. ProgramRefusedError, PreflightError"""
    child = Child("service.milling.preflight_child")
    try:
        answer = child.ask({"path": str(path), **request}, on_share=on_progress)
        if refused := answer.get("refused"):
            raise ProgramRefusedError(**refused)
        if reason := answer.get("failed"):
            raise _make_error(path, reason)
    except ChildError as error:
        raise _make_error(path, f"the reading process ended early ({error})") from None
    finally:
        child.end()


def _make_error(path: Path, reason: str) -> PreflightError:
    return PreflightError(Phrase("pre-flight of {path}: {reason}", path=path, reason=reason))


def _load_kept(folder: Path, held_against: str, content: str | None) -> Preflight | None:
    """Load the kept result for this content, if it is there and whole."""
    if content is None:
        return None
    kept = folder / f"{held_against}-{content}.json"
    try:
        found = Preflight.from_json(kept.read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    with contextlib.suppress(OSError):
        os.utime(kept)
    return found


def _read_note(quick: Path) -> str | None:
    try:
        return quick.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return None


def _note(quick: Path, content: str) -> None:
    staging = quick.with_name(f".{quick.name}.{os.getpid()}")
    staging.write_text(content, encoding="ascii")
    staging.replace(quick)


def _sha256(path: Path) -> str:
    with path.open("rb", buffering=0) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest(values: list[Any]) -> str:
    return hashlib.blake2b(json.dumps(values, sort_keys=True).encode(), digest_size=12).hexdigest()


@functools.cache
def _sources() -> str:
    """Return the state of the judging code, so that a new version judges again."""
    machines = _ROOT / "machines"
    files = [file for pattern in ("gcode/*.py", "preflight/*.py", "roland/rml*.py") for file in machines.glob(pattern)]
    own = (_ROOT / "cam" / "duration.py", _ROOT / "service" / "milling" / "preflight_child.py")
    return hash_files((*sorted(files), *own))
