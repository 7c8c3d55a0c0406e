"""A journal is what survives: any prefix, any torn tail, any moment of a rotation."""

from __future__ import annotations

import random
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.errors import JournalError
from machines.journal.disk import RealDisk, RealFile, ThreadSyncer
from machines.journal.journal import Journal, decode, encode, read_journal, records_in
from phrases.phrase import Phrase
from tests.machines.disks import ROOM, Clock, FullDisk, InlineSyncer
from tests.trials.kill_bench import LossyDisk


def filled(folder: Path, count: int, *, rotate_bytes: int = 1000, disk: RealDisk | None = None) -> Journal:
    journal = Journal(folder, disk=disk, syncer=InlineSyncer(Clock()), rotate_bytes=rotate_bytes)
    for number in range(count):
        journal.append("mark", line=number, **{f"key{number % 5}": number})
    return journal


@given(st.dictionaries(st.text(max_size=8), st.one_of(st.integers(), st.text(max_size=20), st.none()), max_size=5))
def test_a_line_comes_back_as_it_went(record: dict[str, object]) -> None:
    line = encode(record)
    assert line.endswith(b"\n") and line.count(b"\n") == 1
    assert decode(line[:-1]) == record


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_a_changed_byte_is_noticed(place: int, flip: int) -> None:
    line = bytearray(encode({"n": 1, "kind": "mark", "line": 123456, "words": "held"})[:-1])
    line[place % len(line)] ^= flip
    found = decode(bytes(line))
    assert found is None or found == {"n": 1, "kind": "mark", "line": 123456, "words": "held"}  # case of a crc digit


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_any_torn_tail_leaves_a_state_that_once_was_true(data: st.DataObject) -> None:
    """Cut the file anywhere and add rubbish: what is read is exactly the state after some earlier record."""
    with TemporaryDirectory() as made:
        folder = Path(made)
        filled(folder, 30, rotate_bytes=1 << 20).close()
        (path,) = folder.glob("*.log")
        whole = path.read_bytes()
        keep = data.draw(st.integers(0, len(whole)))
        path.write_bytes(whole[:keep] + data.draw(st.binary(max_size=40)))
        content = read_journal(folder)
        ends = [i + 1 for i, byte in enumerate(whole) if byte == 10]
        expected = sum(1 for end in ends if end <= keep)
        if content is None:
            assert expected == 0
        else:
            assert content.records == expected and content.state["line"] == expected - 1
            assert bool(content.torn) == (path.stat().st_size > (ends[expected - 1]))


def test_a_record_out_of_sequence_ends_the_reading() -> None:
    lines = [encode({"n": n, "kind": "mark"}) for n in (1, 2, 4)]
    assert [record["n"] for record in records_in(b"".join(lines))] == [1, 2]


def test_rotation_keeps_the_state_and_few_files(tmp_path: Path) -> None:
    journal = filled(tmp_path, 500)
    journal.close()
    assert len(list(tmp_path.glob("*.log"))) <= 2
    content = read_journal(tmp_path)
    assert content is not None and content.torn == ""
    assert content.state == {"line": 499, "key0": 495, "key1": 496, "key2": 497, "key3": 498, "key4": 499}


def test_a_phrase_is_one_again_after_a_restart_and_a_rotation(tmp_path: Path) -> None:
    why = Phrase("line {line}: {words}", line=3, words=Phrase("cuts with the spindle off or at S0"))
    filled(tmp_path, 1).append("parked", warnings=[why], words="plain")
    for _ in range(2):
        Journal(tmp_path, syncer=InlineSyncer(Clock())).append("mark", line=1)
    content = read_journal(tmp_path)
    assert content is not None and content.torn == "" and content.state["words"] == "plain"
    (back,) = content.state["warnings"]
    assert isinstance(back, Phrase) and back.plain() == why.plain()


def test_reopened_after_a_tear_it_goes_on_in_a_new_file(tmp_path: Path) -> None:
    filled(tmp_path, 10).close()
    newest = sorted(tmp_path.glob("*.log"))[-1]
    newest.write_bytes(newest.read_bytes()[:-3])
    journal = Journal(tmp_path, syncer=InlineSyncer(Clock()))
    assert "torn" in journal.torn and journal.state["line"] == 8
    journal.append("mark", line=99)
    journal.close()
    content = read_journal(tmp_path)
    assert content is not None and content.state["line"] == 99 and content.torn == ""


@pytest.mark.parametrize("seed", range(60))
def test_power_loss_costs_at_most_the_time_between_two_syncs(seed: int, tmp_path: Path) -> None:
    """Records every 0.1 s, fsync every 0.5 s, files of 600 bytes: what is left is at most 0.6 s old."""
    chance = random.Random(seed)
    disk = LossyDisk()
    clock = Clock()
    journal = Journal(tmp_path, disk=disk, syncer=InlineSyncer(clock, 0.5), rotate_bytes=600)
    journal.append("start", at=0.0)
    journal.sync()
    for number in range(1, chance.randint(2, 80)):
        clock.now_s = number / 10
        journal.append("mark", at=clock.now_s, number=number)
    disk.lose_power(chance)
    content = read_journal(tmp_path)
    assert content is not None
    assert clock.now_s - 0.6001 <= content.state["at"] <= clock.now_s
    again = Journal(tmp_path, disk=disk, syncer=InlineSyncer(clock, 0.5))
    again.append("mark", at=clock.now_s + 1)
    again.sync()
    disk.lose_power(chance)
    content = read_journal(tmp_path)
    assert content is not None and content.state["at"] == clock.now_s + 1


@pytest.mark.parametrize("room", [0, 1, 30, 200, 500, 999])
def test_a_full_disk_is_an_error_and_the_journal_goes_on_when_there_is_room(room: int, tmp_path: Path) -> None:
    disk = FullDisk()
    journal = filled(tmp_path, 5, disk=disk)
    disk.room = room
    with pytest.raises(JournalError, match="no space left"):
        for number in range(5, 100):
            journal.append("mark", line=number)
    failed_at = journal.state["line"]
    with pytest.raises(JournalError, match="no space left"):
        journal.append("mark", line=100)
    with pytest.raises(JournalError):
        journal.repair()
    content = read_journal(tmp_path)
    assert content is not None and failed_at - 1 <= content.state["line"] < 100
    disk.room = ROOM
    journal.repair()
    journal.append("mark", other=1)
    journal.close()
    content = read_journal(tmp_path)
    assert content is not None and content.state["line"] == 100 and content.state["other"] == 1


def test_a_failed_fsync_shows_at_the_next_append(tmp_path: Path) -> None:
    disk, clock = FullDisk(), Clock()
    journal = Journal(tmp_path, disk=disk, syncer=InlineSyncer(clock, 0.5))
    journal.append("mark", line=1)
    disk.sync_fails = True
    clock.now_s = 1.0
    journal.append("mark", line=2)
    with pytest.raises(JournalError, match="input/output error"):
        journal.append("mark", line=3)


class SlowFile(RealFile):
    """Its fsync ends only when the test lets it."""

    def __init__(self, path: Path, gate: threading.Event) -> None:
        super().__init__(path)
        self.gate = gate
        self.syncs = 0

    def sync(self) -> None:
        self.gate.wait(10)
        self.syncs += 1


class SlowDisk(RealDisk):
    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.files: list[SlowFile] = []

    def create(self, path: Path) -> SlowFile:
        self.files.append(SlowFile(path, self.gate))
        return self.files[-1]


def test_a_stuck_fsync_does_not_stall_the_writer_not_even_across_a_rotation(tmp_path: Path) -> None:
    disk = SlowDisk()
    journal = Journal(tmp_path, disk=disk, syncer=ThreadSyncer(0.001), rotate_bytes=2000)
    journal.append("start", line=0)
    journal.sync()
    assert disk.files[0].syncs >= 1
    disk.gate.clear()
    began_s = time.monotonic()
    for number in range(200):
        journal.append("mark", line=number)
    assert time.monotonic() - began_s < 5.0  # the gate is shut: had one append waited for it, this were 10 s
    assert len(disk.files) > 1
    content = read_journal(tmp_path)
    assert content is not None and content.state["line"] == 199
    disk.gate.set()
    journal.close()
    assert read_journal(tmp_path).state["line"] == 199  # type: ignore[union-attr]


def test_a_disk_that_never_answers_is_an_error(tmp_path: Path) -> None:
    disk = SlowDisk()
    journal = Journal(tmp_path, disk=disk, syncer=ThreadSyncer(0.001, timeout_s=0.05))
    journal.append("start", line=0)
    journal.sync()
    disk.gate.clear()
    journal.append("mark", line=1)
    with pytest.raises(JournalError, match="has not finished an fsync"):
        journal.sync()
    disk.gate.set()
    journal.close()
