"""A judge that sees nothing would pass every storm: each broken law is made on purpose, and must be a line."""

from __future__ import annotations

import hashlib
import os
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from tests.trials.server.chaos import SHARES, deck
from tests.trials.server.customers import Customers, Order
from tests.trials.server.deployment import Deployment, embedded
from tests.trials.server.judge import Verdict, database_faults, half_objects, judged
from tests.trials.server.processes import MARK, wait_until
from tests.trials.server.storm import Result, Size, _calm, _stopped
from tests.trials.server.watching import Watching
from tests.waiting import PATIENCE_S

SIZE = Size(jobs=0, kinds=0, kills=0, patience_s=120.0)


@pytest.mark.thorough
def test_the_judge_sees_each_broken_law(tmp_path: Path) -> None:
    with embedded(tmp_path) as deployment:
        customers = Customers(deployment.url, [Order(kind=0) for _ in range(8)])
        customers.begin()
        customers.release(8)
        assert wait_until(lambda: len(customers.acked) == 8 and customers.all_ended(), 120.0, every_s=0.2)
        customers.close()
        clean = Result(Verdict(), {}, 0, 0.0, 0, {})
        _calm(deployment, customers, deployment.data[0] / "objects", SIZE, clean)
        assert clean.broken == []
        assert (clean.verdict.jobs, clean.verdict.equal) == (8, 7)
        _break_everything(deployment, customers)
        verdict = judged(deployment.url, customers.orders, customers.states())
        with _orphan(deployment), _orphan(deployment, marked=False):
            broken = Result(verdict, {}, 0, 0.0, 0, {})
            _stopped(deployment, deployment.data[0] / "objects", None, broken)
    _assert_line("ended failed", verdict.lost)
    _assert_line("is not known", verdict.lost)
    _assert_line("never committed ['check']", verdict.lost)
    _assert_line("belongs to no order", verdict.doubled)
    _assert_line("made ['", verdict.doubled)
    _assert_line("2 ends", verdict.doubled)
    _assert_line("began again after it was committed", verdict.run_again)
    _assert_line("after it was done", verdict.run_again)
    _assert_line("differs from an equal job in ['lens.stl']", verdict.differing)
    _assert_line("is not what its hash says", verdict.half)
    _assert_line("half: ", verdict.half)
    _assert_line("left over: incoming", verdict.half)
    _assert_line("scratch/", broken.left)
    _assert_line("left after the stop", broken.orphans)
    _assert_line("uses the data after the stop", broken.orphans)


def _break_everything(deployment: Deployment, customers: Customers) -> None:
    """One law for each order, and those that are about folders."""
    data = deployment.data[0]
    orders = customers.orders
    ids = [next(iter(order.ids)) for order in orders]
    stored = data / "objects"
    with sqlite3.connect(data / "causticmill.sqlite", timeout=PATIENCE_S) as book:
        book.execute("UPDATE jobs SET state = 'failed' WHERE id = ?", (ids[0],))
        query = "SELECT seq, kind, data, at FROM events WHERE job_id = ? ORDER BY seq DESC LIMIT 1"
        seq, kind, words, at = book.execute(query, (ids[1],)).fetchone()
        row = (ids[1], seq + 1, at, kind, words)
        book.execute("INSERT INTO events (job_id, seq, at, kind, data) VALUES (?, ?, ?, ?, ?)", row)
        started = "UPDATE events SET kind = 'stage.started', data = replace(data, '\"check\"', '\"map\"')"
        book.execute(f"{started} WHERE job_id = ? AND kind LIKE 'stage.%' AND data LIKE '%\"check\"%'", (ids[2],))
        other = "(SELECT sha256 FROM artifacts WHERE job_id = ?1 AND name = 'report.html')"
        book.execute(f"UPDATE artifacts SET sha256 = {other} WHERE job_id = ?1 AND name = 'lens.stl'", (ids[3],))
        columns = "job_id, attempt, number, stage, key, state, executor, fence, started_at, ended_at"
        again = columns.replace("number", "number + 1")
        book.execute(
            f"INSERT INTO stage_runs ({columns}) SELECT {again} FROM stage_runs WHERE job_id = ? AND stage = 'map'",
            (ids[4],),
        )
        query = "SELECT sha256 FROM artifacts WHERE job_id = ? AND name = 'report.json'"
        (half,) = book.execute(query, (ids[4],)).fetchone()
    book.close()
    httpx.delete(f"{deployment.url}/v1/jobs/{ids[5]}", trust_env=False, timeout=PATIENCE_S).raise_for_status()
    orders[6].ids.clear()
    orders[6].ids.add(ids[7])
    orders[7].ids.add(ids[0])
    path = stored / half[:2] / half
    path.chmod(0o644)
    path.write_bytes(path.read_bytes()[:-1])
    (stored / "incoming" / "part").write_bytes(b"x")
    (data / "scratch").mkdir(exist_ok=True)
    (data / "scratch" / "forgotten").write_bytes(b"x")


@contextmanager
def _orphan(deployment: Deployment, *, marked: bool = True) -> Iterator[None]:
    """A process that the server could have left: known by its mark, or only by what it has open."""
    environment = {**os.environ, MARK: deployment.mark} if marked else dict(os.environ)
    words = [sys.executable, "-c", "import time; time.sleep(120)"]
    process = subprocess.Popen(words, cwd=deployment.data[0], env=environment)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def _assert_line(words: str, lines: list[str]) -> None:
    assert any(words in line for line in lines), (words, lines)


def test_two_processes_at_one_job_are_seen_only_if_they_stay(tmp_path: Path) -> None:
    watching = Watching(Deployment(tmp_path, [], port=1))
    together: dict[str, set[int]] = {"a": {1, 2}, "b": {3}}
    watching._judge([together] * 4 + [{"a": {2}}])
    assert watching.doubled == []
    watching._judge([together] * 5)
    watching._judge([together] * 5)
    assert watching.doubled == ["two processes at the same time at job a: [1, 2]"]


def test_a_damaged_database_is_seen(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    with sqlite3.connect(path) as book:
        book.execute("CREATE TABLE t (a TEXT UNIQUE)")
        book.executemany("INSERT INTO t VALUES (?)", [(f"{number:0200d}",) for number in range(500)])
    book.close()
    assert database_faults(path) == []
    row = f"{7:0200d}".encode()  # stands in the table and in its index
    path.write_bytes(path.read_bytes().replace(row, b"1" + row[1:], 1))
    assert database_faults(path) != []


def test_a_deck_holds_enough_of_each_kind() -> None:
    cards = deck(125, freezes=12, restarts=12)
    assert len(cards) == 149
    assert min(cards.count(kind) for kind in (*SHARES, "freeze", "database restart")) >= 10


def test_the_judge_sees_half_objects(tmp_path: Path) -> None:
    whole = b"whole"
    name = hashlib.sha256(whole).hexdigest()
    (tmp_path / name).write_bytes(whole)
    assert half_objects(tmp_path) == []
    (tmp_path / name).write_bytes(whole[:-1])
    (tmp_path / ".tmp-1").write_bytes(b"")
    assert len(half_objects(tmp_path)) == 2
