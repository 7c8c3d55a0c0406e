"""Pictures of a run: few, and even over its time, however long it is; a crash costs pictures, nothing else."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.server.fleet import timelapse
from service.server.fleet.timelapse import KEPT_RUNS, MOST_PICTURES, Timelapses
from tests.machines.disks import Clock

TICK_S = 10.0


def film(kept: Timelapses, clock: Clock, run: str, ticks: int, picture: bytes = b"picture") -> None:
    for _ in range(ticks):
        clock.now_s += TICK_S
        if kept.is_due(run):
            kept.keep(run, picture)


@settings(max_examples=6, deadline=None)
@given(ticks=st.integers(1, 1200), away=st.integers(0, 200))
def test_pictures_of_a_run_are_few_and_even(ticks: int, away: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        clock = Clock(1.8e9)
        film(Timelapses(Path(folder), clock), clock, "run", ticks)
        first = Timelapses(Path(folder), clock).list_times("run")
        assert min(ticks, MOST_PICTURES / 2) <= len(first) <= MOST_PICTURES
        gaps = [after - before for before, after in pairwise(first)]
        assert max(gaps, default=0) <= 2.2 * min(gaps, default=0)
        assert (first[0], first[-1]) == (1.8e9 + TICK_S, pytest.approx(clock.now_s, abs=2.2 * max(gaps, default=0)))
        clock.now_s += away * TICK_S  # the server was down
        film(Timelapses(Path(folder), clock), clock, "run", 40)
        assert len(first) / 2 <= len(Timelapses(Path(folder), clock).list_times("run")) <= MOST_PICTURES


def test_large_pictures_become_fewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timelapse, "MOST_BYTES", 1000)
    clock = Clock(1.8e9)
    kept = Timelapses(tmp_path, clock)
    film(kept, clock, "run", 100, bytes(90))
    assert 4 <= len(kept.list_times("run")) <= 11


def test_pictures_of_the_newest_runs_are_kept(tmp_path: Path) -> None:
    clock = Clock(1.8e9)
    kept = Timelapses(tmp_path, clock)
    for number in range(KEPT_RUNS + 3):
        film(kept, clock, f"run-{number}", 2)
    assert len(list(tmp_path.iterdir())) == KEPT_RUNS and kept.list_times(f"run-{KEPT_RUNS + 2}")


def test_a_picture_is_whole_or_not_there(tmp_path: Path) -> None:
    clock = Clock(1.8e9)
    kept = Timelapses(tmp_path, clock)
    film(kept, clock, "run", 1)
    (tmp_path / "run" / "1700000000.part").write_bytes(b"half")
    (tmp_path / "run" / "notes.jpg").write_bytes(b"of somebody else")
    (at_s,) = kept.list_times("run")
    assert (kept.read("run", at_s), kept.read("run", 5), kept.read("gone", 5)) == (b"picture", None, None)
    assert (tmp_path / "run" / f"{at_s}.jpg").stat().st_mode & 0o777 == 0o600
