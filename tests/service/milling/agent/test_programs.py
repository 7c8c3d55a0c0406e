"""The agent's program store: a name appears only for a program that is whole, right and on disk."""

from __future__ import annotations

import asyncio
import errno
import hashlib
from collections.abc import AsyncIterator, Iterable
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.http.problems import Problem, problem_of
from service.milling.agent import programs
from service.milling.agent.programs import ProgramStore

PROGRAM = b"G21 G90\nG1 X1 F100\nM2\n" * 1000


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


async def in_pieces(pieces: Iterable[bytes]) -> AsyncIterator[bytes]:
    for piece in pieces:
        yield piece


def receive(store: ProgramStore, sha256: str, pieces: Iterable[bytes], announced: int | None = None) -> bool:
    return asyncio.run(store.receive(sha256, in_pieces(pieces), announced_bytes=announced))[1]


@given(cuts=st.lists(st.integers(0, len(PROGRAM)), max_size=6).map(sorted))
def test_what_is_stored_is_what_came_however_it_was_cut(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("store")
    store = ProgramStore(folder, max_bytes=1 << 20)
    bounds = [0, *cuts, len(PROGRAM)]
    pieces = [PROGRAM[a:b] for a, b in pairwise(bounds)]
    assert receive(store, digest(PROGRAM), pieces)
    assert store.path_of(digest(PROGRAM)).read_bytes() == PROGRAM
    assert not receive(store, digest(PROGRAM), pieces)  # the second time it is here already
    assert [entry.bytes for entry in store.entries()] == [len(PROGRAM)]


@pytest.mark.parametrize(
    ("sha256", "pieces", "announced", "status", "words"),
    [
        (digest(b"other"), [PROGRAM], None, 422, "nothing is kept"),
        ("../../etc/passwd", [PROGRAM], None, 422, "64 digits"),
        (digest(PROGRAM).upper(), [PROGRAM], None, 422, "64 digits"),
        (digest(PROGRAM), [PROGRAM, b"x" * 200_000], None, 413, "longer than 100000"),
        (digest(PROGRAM), [PROGRAM], 10**6, 413, "up to 100000"),
    ],
)
def test_what_is_wrong_is_refused_and_leaves_nothing(
    tmp_path: Path, sha256: str, pieces: list[bytes], announced: int | None, status: int, words: str
) -> None:
    store = ProgramStore(tmp_path, max_bytes=100_000)
    with pytest.raises(Problem, match=words) as refused:
        receive(store, sha256, pieces, announced)
    assert (refused.value.status, list(tmp_path.iterdir())) == (status, [])


def test_a_connection_that_breaks_off_leaves_nothing(tmp_path: Path) -> None:
    async def broken() -> AsyncIterator[bytes]:
        yield PROGRAM[:1000]
        raise Problem(400, "the connection ended")

    store = ProgramStore(tmp_path, max_bytes=1 << 20)
    with pytest.raises(Problem):
        asyncio.run(store.receive(digest(PROGRAM), broken(), announced_bytes=None))
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_clear_line_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_file: BinaryIO) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(programs, "_sync", full)
    store = ProgramStore(tmp_path, max_bytes=1 << 20)
    with pytest.raises(OSError) as error:
        receive(store, digest(PROGRAM), [PROGRAM])
    told = problem_of(error.value)
    assert (told.status, told.detail) == (507, "cannot write: no space left on the disk")
    assert list(tmp_path.iterdir()) == []


def test_room_for_the_journal_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "_SPARE_BYTES", 1 << 60)
    store = ProgramStore(tmp_path, max_bytes=1 << 20)
    with pytest.raises(Problem, match="reserved for the journal") as refused:
        receive(store, digest(PROGRAM), [PROGRAM], len(PROGRAM))
    assert refused.value.status == 507


def test_what_a_killed_agent_left_half_written_is_cleared_at_the_start(tmp_path: Path) -> None:
    (tmp_path / f"{digest(PROGRAM)}.1a2b3c4d.part").write_bytes(PROGRAM[:10])
    assert list(ProgramStore(tmp_path, max_bytes=1 << 20).entries()) == []
    assert list(tmp_path.iterdir()) == []
