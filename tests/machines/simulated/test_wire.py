"""The wire: bytes are lost exactly where a ring of so many bytes loses them; faults come when and where planned."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.simulated import GRBL_11, KINDS, Fault, Faults, Recording, SimulatedMill, parse_fault
from machines.simulated.serial_side import SerialSide
from tests.machines.simulated.terminal import power_up


@given(
    chunks=st.lists(st.tuples(st.floats(0, 0.02), st.integers(1, 300)), min_size=1),
    looks=st.lists(st.floats(0.0, 0.05), min_size=1),
    ring=st.integers(1, 200),
)
def test_a_busy_ring_holds_what_fits_and_loses_the_rest(chunks, looks, ring):
    """Against a model that goes byte by byte."""
    byte_s = 10 / 115200
    side = SerialSide(ring, 104, crlf_answered_twice=True)
    side.byte_s = byte_s
    arrivals, now, free = [], 0.0, 0.0
    for wait, count in chunks:
        now += wait
        side.receive(b"x" * count, now)
        start = max(now, free)
        arrivals += [start + (k + 1) * byte_s for k in range(count)]
        free = start + count * byte_s
    now = 0.0
    for wait in looks:
        now += wait
        side.admit(now)
        arrived = sum(a <= now + 1e-12 for a in arrivals)
        assert abs(len(side.ring) + side.lost_overflow - arrived) <= 1  # a byte just arriving, by rounding
        assert len(side.ring) == min(ring, len(side.ring) + side.lost_overflow)
        assert len(side.ring) <= ring and (side.lost_overflow == 0 or len(side.ring) == ring)


def counted_stream(mill, port, lines, window):
    """Send with at most `window` bytes unanswered; returns the answers."""
    answers, sent, waiting = [], 0, []
    while len(answers) < len(lines):
        while sent < len(lines) and sum(waiting) + len(lines[sent]) <= window:
            port.write(lines[sent])
            waiting.append(len(lines[sent]))
            sent += 1
        words = port.read(5.0)
        if not words:
            return answers
        for word in words.split(b"\r\n"):
            if word.startswith((b"ok", b"error")):
                answers.append(word)
                waiting.pop(0)
    return answers


def short_lines(n):
    return [b"G1F3000X0.001\n", *[f"X{k * 0.1:.3f}Y{k % 7 * 0.05:.3f}\n".encode() for k in range(1, n)]]


def started(traits=GRBL_11, faults=None, seed=0, **more):
    mill = SimulatedMill(traits, faults, seed, **more)
    port = power_up(mill)
    return mill, port


def test_counting_to_the_ring_size_never_loses_a_byte_and_ignoring_it_does():
    mill, port = started()
    assert counted_stream(mill, port, short_lines(500), 128) == [b"ok"] * 500
    assert mill.serial.lost_overflow == 0
    mill, port = started()
    counted_stream(mill, port, short_lines(500), 600)
    assert mill.serial.lost_overflow > 0


def test_the_wire_carries_its_rate_and_no_more():
    mill, port = started(replace(GRBL_11, lines_per_s=None).with_settings({120: 9000, 121: 9000, 122: 9000}))
    start = mill.now_s
    lines = [f"G1X{k * 0.01:.5f}Y{0.005 * k:.4f}F3000\n".encode() for k in range(2000)]
    counted_stream(mill, port, lines, 128)
    rate = sum(map(len, lines)) / (mill.now_s - start)
    assert 0.97 * 11520 <= rate <= 11520


def test_an_echoing_controller_is_bounded_by_the_way_back():
    """33 bytes back for 20 there: about 340 lines a second."""
    mill, port = started(replace(GRBL_11, lines_per_s=None, echo=True).with_settings({120: 9000, 121: 9000}))
    start = mill.now_s
    lines = [f"X{10 + k * 0.01:.7f}Y{k * 0.01:.5f}\n".encode()[:19] + b"\n" for k in range(1000)]
    counted_stream(mill, port, [b"G1F3000\n", *lines], 128)
    assert 300 <= 1000 / (mill.now_s - start) <= 380


@pytest.mark.parametrize("kind", KINDS)
def test_each_fault_happens_once_where_planned_and_is_logged(kind):
    faults = Faults([Fault(kind=kind, line=50, length_s=0.05)])
    mill, port = started(faults=faults)
    try:
        counted_stream(mill, port, short_lines(200), 128)
    except Exception as error:
        assert kind == "disconnect" and "gone" in str(error)
    assert [f.kind for f in faults.log] == [kind]
    assert abs(faults.log[0].line - 50) <= 25


def test_a_dropped_line_end_merges_two_lines():
    faults = Faults([Fault(kind="drop", line=50)])
    mill, port = started(faults=faults)
    answers = counted_stream(mill, port, short_lines(100), 128)
    assert len(answers) == 99 and answers.count(b"error:25") == 1


@pytest.mark.parametrize(
    ("fault", "sent", "answers"),
    [
        (Fault(kind="duplicate", byte=4), b"G4P0\n", [b"ok", b"ok"]),
        (Fault(kind="duplicate", byte=0), b"G4P0\n", [b"error:2"]),
        (Fault(kind="flip", byte=1, mask=0x04), b"G4P0\n", [b"error:36"]),
        (Fault(kind="drop", byte=3), b"G4P0\n", [b"error:2"]),
        (Fault(kind="lose-reply", line=1), b"G4P0\n", []),
        (Fault(kind="duplicate-reply", line=1), b"G4P0\n", [b"ok", b"ok"]),
        (Fault(kind="mangle-reply", line=1, mask=0x01), b"G4P0\n", [b"nk"]),
        (Fault(kind="drop-reply-byte", line=1), b"G4P0\n", [b"k"]),
    ],
)
def test_what_a_byte_fault_does(fault, sent, answers):
    mill, port = started(replace(GRBL_11, lines_per_s=None), Faults([fault]))
    port.write(sent)
    mill.advance(mill.now_s + 1.0)
    assert mill.output().split() == answers


def test_a_delayed_byte_comes_later_and_so_does_all_behind_it():
    mill, port = started(faults=Faults([Fault(kind="delay", byte=2, length_s=0.5)]))
    port.write(b"G4P0\n")
    before = mill.now_s
    assert port.read(2.0) == b"ok\r\n"
    assert 0.5 < mill.now_s - before < 0.51


def test_the_main_loop_waits_while_the_transmit_buffer_is_full():
    mill, port = started()
    port.write(b"$#\nG4P0\n")
    start, came = mill.now_s, b""
    while b"ok" not in came:
        came += port.read(1.0)
    assert mill.firmware.received == 2  # when the first ok has come, the second line is already under way
    mill, port = started(replace(GRBL_11, tx_bytes=0))
    port.write(b"$#\nG4P0\n")
    mill.advance(start + len(came) * 10 / 115200)
    assert mill.firmware.received == 1


def trace(seed):
    recording = Recording()
    mill, port = started(faults=Faults.by_seed(seed, count=3, lines=(5, 150)), seed=seed, recording=recording)
    answers = []
    try:
        answers = counted_stream(mill, port, short_lines(200), 128)
    except Exception as error:
        answers = [str(error)]
    mill.advance(mill.now_s + 5.0)
    return answers, recording.segments, mill.faults.log


@pytest.mark.parametrize("seed", range(5))
def test_the_same_seed_gives_the_same_run(seed):
    assert trace(seed) == trace(seed)


def test_other_seeds_give_other_faults():
    assert len({Faults.by_seed(s).plan for s in range(100)}) > 90


def test_faults_in_words():
    assert parse_fault("drop@byte=12") == Fault(kind="drop", byte=12)
    assert parse_fault("disconnect@t=2.5:3") == Fault(kind="disconnect", at_s=2.5, length_s=3.0)
    for bad in ("melt@line=1", "drop", "drop@line=x", "drop@when=1"):
        with pytest.raises(ValueError, match="fault"):
            parse_fault(bad)
