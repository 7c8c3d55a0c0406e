"""Writes the programs of a job in one file, for controls that change their tools themselves, from the programs that
have passed their checks. The file is read back and must make the same moves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cam.joining import find_tool_changes, hash_moves, join_programs
from cam.posts.post import Post
from cam.reading.gcode import LANGUAGES, ProgramError, read_parts
from machines.profile import MachineProfile
from phrases.phrase import Phrase
from service.errors import FailedError
from service.job.files import ONE_PROGRAM, names_of_pass, programs_in_order, read_chunks, write_program
from service.job.spec.resolve import post_of


def write_one_program(folder: Path, report: Mapping[str, Any], machine: MachineProfile) -> dict[str, Any]:
    """Write all programs of a job as one; return its part of the report: the file, its time, where it changes tools,
    and the offset of each program's lines in it. FailedError if it does not make the same moves.
    """
    post, rows = post_of(machine), programs_in_order(report)
    assert isinstance(post, Post)  # RML-1 has no word for a tool change
    files = [name for row in rows for name in names_of_pass(row)]
    paths = [folder / name for name in files]
    written = write_program(folder / f"{ONE_PROGRAM}{post.suffix}", join_programs(map(read_chunks, paths), post))
    path = folder / written.file
    require_same_moves(path, paths, machine)
    changes, own = _find_changes(path), [_find_changes(one)[0][0] for one in paths]
    return {
        **asdict(written),
        "time_s": sum(row["time_s"] for row in rows),
        "changes": [
            {"line": line, "tool": tool, "file": file, "lines_before": line - own_line}
            for (line, tool), file, own_line in zip(changes, files, own, strict=True)
        ],
    }


def _find_changes(path: Path) -> list[tuple[int, int]]:
    with path.open("rb") as lines:
        return find_tool_changes(lines)


def require_same_moves(path: Path, programs: Sequence[Path], machine: MachineProfile) -> None:
    """Raise FailedError unless a program makes the moves of the given ones, one after the other."""
    language = LANGUAGES[machine.dialect]
    try:
        found = hash_moves(read_parts([read_chunks(path)], language, changes_tools=True))
    except ProgramError as error:
        raise FailedError(Phrase("{name}: {cause}", name=path.name, cause=str(error))) from error
    if found != hash_moves(read_parts(map(read_chunks, programs), language)):
        words = Phrase(
            "{name}: does not move as the programs that were checked, {first} to {last}; make the job again",
            name=path.name,
            first=programs[0].name,
            last=programs[-1].name,
        )
        raise FailedError(words)
