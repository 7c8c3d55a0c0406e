"""The MDX-40A over USB: fed block by block through rollingmill's own classes, on a simulated mill."""

from __future__ import annotations

from itertools import pairwise
from math import dist
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import (
    Event,
    FaultCause,
    Faulted,
    Home,
    MillState,
    Notice,
    Override,
    ProgramDone,
    ProgramLine,
    Stopped,
)
from machines.errors import NotAllowedError, PortError
from machines.roland.usb_device import decode_state, open_mdx40a
from machines.roland.usb_driver import RolandUsbDriver
from tests.machines.roland.simulated_blocks import SimulatedAxes
from tests.machines.roland.simulated_device import SimulatedMdx40a, SimulatedUsbError, UsbFace, open_simulated

machine = pytest.importorskip("rollingmill.machine")
usb = pytest.importorskip("rollingmill.usb")

HEAD = [b"%", b"O00000001", b"G90", b"G21", b"G54", b"S12000", b"M03", b"G00 Z5.0", b"G00 X0.0 Y0.0"]
TAIL = [b"G00 Z5.0", b"M05", b"M02", b"%"]


def listing(*cuts: bytes) -> list[ProgramLine]:
    return [ProgramLine(n, 20 * n, text) for n, text in enumerate([*HEAD, *cuts, *TAIL], 1)]


def square(turns: int) -> list[bytes]:
    corners = [b"X10.0 Y0.0", b"X10.0 Y10.0", b"X0.0 Y10.0", b"X0.0 Y0.0"]
    cuts = [b"G01 Z-1.0 F300.0"]
    for turn in range(turns):
        cuts += [b"G01 %s Z-%d.%03d F1200.0" % (corner, 1, 100 * turn) for corner in corners]
    return cuts


def connect(mill: SimulatedMdx40a, dialect: str = "roland-nc") -> RolandUsbDriver:
    driver = RolandUsbDriver(open_simulated(mill), dialect=dialect)
    driver.connect()
    driver.poll(0.5)
    assert driver.status.state is MillState.IDLE, driver.status
    return driver


def begin(lines: list[ProgramLine], **traits: Any) -> tuple[SimulatedMdx40a, RolandUsbDriver]:
    """A mill to which a program has begun to go."""
    mill = SimulatedMdx40a(**traits)
    driver = connect(mill)
    driver.start(iter(lines))
    return mill, driver


def cutting(turns: int, polls: int) -> tuple[SimulatedMdx40a, RolandUsbDriver]:
    """A mill in the middle of some turns of a square."""
    mill, driver = begin(listing(*square(turns)))
    for _ in range(polls):
        driver.poll(0.5)
    return mill, driver


def run(driver: RolandUsbDriver, mill: SimulatedMdx40a, most_s: float = 4000.0) -> list[Event]:
    events: list[Event] = []
    end_s = mill.now_s + most_s
    while mill.now_s < end_s:
        events += driver.poll(1.0)
        if any(isinstance(event, ProgramDone | Faulted | Stopped) for event in events):
            return events
    raise AssertionError(f"not done: {driver.status} {driver.progress}")


def fault_of(events: list[Event]) -> Faulted:
    return next(event for event in events if isinstance(event, Faulted))


def test_a_program_is_cut_whole_in_order_and_the_bracket_is_closed_behind_it() -> None:
    lines = listing(*square(3))
    mill, driver = begin(lines)
    assert ProgramDone() in run(driver, mill)
    assert mill.begun == [line.text for line in lines]
    assert mill.counter == sum(len(line.text) + 2 for line in lines)
    assert (driver.progress.answered_line, driver.progress.executed_line) == (len(lines), len(lines))
    brackets = [data for register, data in mill.sets if register == 0x1109]
    assert brackets == [b"\x00", b"\xff"]
    assert mill.ignored_bytes == 0
    assert all(a.end_mm == b.start_mm for a, b in pairwise(mill.cuts))


@settings(max_examples=15, deadline=None)
@given(
    turns=st.integers(1, 6),
    blocks=st.integers(1, 12),
    poll_s=st.floats(0.01, 2.0),
    transfer_s=st.floats(0.0001, 0.01),
)
def test_a_line_called_executed_is_cut_and_the_counter_alone_would_lie(
    turns: int, blocks: int, poll_s: float, transfer_s: float
) -> None:
    """At any moment what the driver calls executed is executed; what the counter calls taken is not yet."""
    lines = listing(*square(turns))
    mill, driver = begin(lines, blocks=blocks, transfer_s=transfer_s)
    ahead = 0
    while ProgramDone() not in driver.poll(poll_s):
        progress, done = driver.progress, len(mill.begun) - (mill.axes.move is not None)
        assert progress.executed_line <= done
        assert progress.executed_line <= progress.answered_line <= progress.sent_line
        ahead = max(ahead, progress.answered_line - done)
    assert ahead > 0


def test_executed_follows_the_mill_closely() -> None:
    mill, driver = begin(listing(*square(5)))
    worst = 0
    while ProgramDone() not in driver.poll(0.2):
        worst = max(worst, len(mill.begun) - driver.progress.executed_line)
    assert worst <= len(HEAD) + 2


def test_rows_of_the_finest_pitch_are_told_apart() -> None:
    """Rows 0.02 mm apart, to and fro and bent: a report, rounded to 0.001 mm, belongs to one row and is found on it."""
    cuts = [b"G01 Z-1.0 F300.0"]
    for row in range(60):
        y, far = f"{0.02 * row:.3f}", row % 2 == 0
        xs = ("0.0", "5.0", "10.0") if far else ("10.0", "5.0", "0.0")
        cuts += [f"G01 X{x} Y{y if x != '5.0' else y[:-1] + '7'} F1200.0".encode() for x in xs]
    mill, driver = begin(listing(*cuts))
    lags = []
    while ProgramDone() not in driver.poll(0.2):
        lags.append(len(mill.begun) - driver.progress.executed_line)
    assert sorted(lags)[len(lags) // 2] == 1
    assert max(lags[10:-10]) <= 2


def test_hold_lets_the_mill_finish_what_it_has_and_resume_skips_nothing() -> None:
    lines = listing(*square(4))
    mill, driver = begin(lines)
    for _ in range(8):
        driver.poll(0.5)
    driver.hold()
    assert driver.status.state is MillState.HOLDING
    taken = driver.progress.sent_line
    for _ in range(20):
        driver.poll(0.5)
    assert driver.status.state is MillState.HELD
    assert driver.progress.sent_line == taken
    assert len(mill.begun) == taken
    driver.resume()
    assert ProgramDone() in run(driver, mill)
    assert mill.begun == [line.text for line in lines]


def test_the_view_button_is_a_pause_and_neither_a_fault_nor_a_stall() -> None:
    mill, driver = cutting(turns=4, polls=6)
    mill.press_view()
    events = [event for _ in range(200) for event in driver.poll(0.5)]
    assert not any(isinstance(event, Faulted) for event in events)
    assert driver.status.state is MillState.HELD
    assert "VIEW" in driver.status.detail
    mill.press_view()
    assert ProgramDone() in run(driver, mill)


def test_the_cover_is_an_emergency_stop_named_in_words() -> None:
    mill, driver = cutting(turns=4, polls=6)
    mill.open_door()
    fault = fault_of(run(driver, mill))
    assert fault.cause is FaultCause.DEVICE
    assert "cover was opened" in fault.words
    assert "Cover opened during operation" in fault.words
    assert not driver.status.position_trusted
    assert driver.status.state is MillState.ALARM
    with pytest.raises(NotAllowedError, match="idle"):
        driver.start(iter(listing()))


@pytest.mark.parametrize(
    "block", [b"G1 X1.0", b"G01 X1", b"G01 X1.0001", b"G91 G53 Z0.0", b"HELLO"], ids=lambda b: b.decode()
)
def test_a_block_the_mill_refuses_stops_the_stream_at_that_line(block: bytes) -> None:
    """If pre-flight let such a block pass, counter and error bit of the mill (or our own reader) show it."""
    lines = listing(b"G01 Z-1.0 F300.0", block, b"G01 X5.0")
    mill, driver = begin(lines)
    fault = fault_of(run(driver, mill))
    assert fault.cause in (FaultCause.DEVICE, FaultCause.PROGRAM_CHANGED)
    if fault.cause is FaultCause.DEVICE:
        assert fault.line == len(HEAD) + 2
        assert "switch it off and on" in fault.words
    assert not any(line.startswith(b"G01 X5.0") for line in mill.begun)


def test_a_wrong_command_set_is_refused_before_the_first_byte() -> None:
    for setting, dialect in ((0, "roland-nc"), (1, "rml-1")):
        mill = SimulatedMdx40a(command_set=setting)
        driver = connect(mill, dialect=dialect)
        with pytest.raises(NotAllowedError, match="selected automatically"):
            driver.start(iter(listing()))
        assert mill.counter == 0
        assert not mill.bracket


def test_a_lift_above_the_top_of_the_machine_is_never_sent() -> None:
    """The simulated mill shows why: after it, everything is a rapid at Z0."""
    mill, driver = begin(listing(*square(1)), origins_mm={3: (50.0, 50.0, -2.0)})
    fault = fault_of(run(driver, mill))
    assert "machine Z 3.000 mm, above the top" in fault.words
    assert not mill.cuts
    blind = SimulatedMdx40a(origins_mm={3: (50.0, 50.0, -2.0)})
    blind.vend_set(0x1109, b"\x00")
    for line in listing(*square(1)):
        blind.bulk_write(line.text + b"\r\n")
        blind.wait(30.0)
    assert all(cut.rapid and cut.end_mm[2] == 0.0 for cut in blind.cuts)


def test_abort_stops_the_mill_and_says_so_when_it_stands() -> None:
    mill, driver = cutting(turns=4, polls=6)
    before = len(mill.cuts)
    driver.abort()
    assert Stopped(position_kept=True) in run(driver, mill)
    mill.wait(100.0)
    assert len(mill.cuts) == before
    assert driver.status.state is MillState.IDLE
    assert not mill.bracket
    driver.start(iter(listing(*square(1))))
    assert ProgramDone() in run(driver, mill)


def test_a_program_read_from_the_middle_gets_its_opening_marks() -> None:
    mill = SimulatedMdx40a()
    driver = connect(mill)
    lines = [ProgramLine(0, 0, b"G90 G21 G54"), ProgramLine(0, 0, b"S12000 M03"), *listing()[7:]]
    driver.start(iter(lines))
    assert ProgramDone() in run(driver, mill)
    assert mill.begun[:3] == [b"%", b"O00000001", b"G90 G21 G54"]


def test_rml_follows_the_user_origin() -> None:
    mill = SimulatedMdx40a()
    driver = connect(mill, dialect="rml-1")
    texts = [b";;^DF;", b"!MC0;V50.0;", b"!RC15;!MC1;", b"Z0,0,500;", b"V10;Z0,0,-50;", b"Z3000,0,-50;", b"!MC0;"]
    driver.start(ProgramLine(n, 0, text) for n, text in enumerate(texts, 1))
    assert ProgramDone() in run(driver, mill)
    assert [cut.end_mm for cut in mill.cuts] == [(50.0, 50.0, -35.0), (50.0, 50.0, -40.5), (80.0, 50.0, -40.5)]
    assert driver.progress.executed_line == len(texts)


def test_a_pulled_cable_is_a_fault_in_words() -> None:
    mill, driver = cutting(turns=4, polls=6)
    mill.unplugged = True
    fault = fault_of(run(driver, mill))
    assert fault.cause is FaultCause.PORT_LOST
    assert "spindle may stay on" in fault.words
    assert driver.status.state is MillState.DISCONNECTED
    assert driver.poll(1.0) == ()
    driver.close()
    assert mill.released == 1, "the interface is let go, so that the mill can be opened anew"


def test_a_mill_that_neither_counts_nor_moves_is_a_stall() -> None:
    mill = SimulatedMdx40a()
    driver = connect(mill)
    mill.wait(1.0)
    driver.start(iter(listing(*square(1))))
    mill.bracket = False  # as if the bracket had been lost: it ignores every byte
    fault = fault_of(run(driver, mill))
    assert fault.cause is FaultCause.STALL
    assert mill.ignored_bytes == len(b"O00000001\r\n")


def test_a_long_slow_move_is_no_stall() -> None:
    mill, driver = begin(
        listing(b"G01 Z-1.0 F300.0", b"G01 X20.0 F7.0", b"G01 X0.0", b"G01 X1.0", b"G01 X2.0"), blocks=1
    )
    assert ProgramDone() in run(driver, mill)


def test_a_mill_that_pauses_between_its_moves_is_not_done_before_the_last() -> None:
    """Idle for a moment with blocks still in its buffer: done means standing still for longer than that."""
    lines = listing(*square(2))
    mill, driver = begin(lines, gap_s=0.45)
    while ProgramDone() not in driver.poll(0.05):
        assert driver.progress.executed_line <= len(mill.begun)
    assert mill.begun == [line.text for line in lines]


def test_a_counter_that_jumps_is_a_fault_and_the_mill_is_stopped() -> None:
    mill, driver = cutting(turns=4, polls=4)
    mill.counter += 1000
    assert fault_of(run(driver, mill)).cause is FaultCause.REPLY_COUNT
    cuts = len(mill.cuts)
    mill.wait(100.0)
    assert len(mill.cuts) == cuts


def test_the_counter_may_wrap() -> None:
    mill, driver = begin(listing(*square(1)), counter=(1 << 32) - 20)
    assert ProgramDone() in run(driver, mill)
    assert mill.counter < 1000


def test_a_changed_frame_is_said_and_stops_the_following() -> None:
    mill, driver = begin(listing(b"G55", *square(1)))
    events = run(driver, mill)
    assert any(isinstance(event, Notice) and "changes the work frame" in event.words for event in events)
    assert ProgramDone() in events


def test_overrides_reach_the_mill_and_what_it_does_not_offer_is_refused() -> None:
    mill = SimulatedMdx40a()
    driver = connect(mill)
    driver.command(Override("feed", 80))
    driver.command(Override("spindle", 110))
    assert mill.sets[-2:] == [(0x0307, bytes([80])), (0x3008, bytes([110]))]
    assert driver.status.overrides == (80, 100, 110)
    with pytest.raises(NotAllowedError, match=r"10\.\.200"):
        driver.command(Override("feed", 5))
    with pytest.raises(NotAllowedError, match="own panel"):
        driver.command(Home())


def test_large_writes_hang_the_simulated_mill_and_the_driver_never_makes_one() -> None:
    mill = SimulatedMdx40a()
    mill.vend_set(0x1109, b"\x00")
    with pytest.raises(SimulatedUsbError):
        mill.bulk_write(bytes(0x8000))
    with pytest.raises(SimulatedUsbError):
        mill.bulk_write(b"%\r\n")
    fresh = SimulatedMdx40a()
    driver = connect(fresh)
    driver.start(iter([*listing(), ProgramLine(99, 0, b"(" + b"x" * 600 + b")")]))
    assert "at most 512" in fault_of(run(driver, fresh)).words


def test_our_reading_of_the_state_block_is_the_librarys() -> None:
    mill = SimulatedMdx40a(axes=SimulatedAxes(machine_mm=(1.234, -5.678, -9.001)))
    block = mill.vend_get(0x0100, 32)
    ours, theirs = decode_state(block), machine._decode_state(block)
    assert ours.machine_mm == (theirs.x_mm, theirs.y_mm, theirs.z_mm)
    assert (ours.flags, ours.spindle_rpm) == (theirs.flags, theirs.spindle_rpm)
    assert (ours.phase == "idle") == theirs.idle
    with pytest.raises(ValueError, match="19 bytes"):
        decode_state(block[:19])


def test_the_librarys_own_sender_runs_on_the_simulated_mill() -> None:
    """rollingmill's CutJob, unchanged: our understanding of its protocol and the simulated mill agree."""
    cutjob = pytest.importorskip("rollingmill.cutjob")
    mill = SimulatedMdx40a()
    face = UsbFace(mill)
    job = cutjob.CutJob.from_bytes(
        machine.MDX40A(usb.MdxUSB(face, 0, face, 2000)), b"".join(line.text + b"\r\n" for line in listing(*square(2)))
    )
    job.run()
    for _ in range(20000):
        job.service()
        if job.state in (job.DONE, job.ERROR):
            break
        mill.wait(0.1)
    assert (job.state, job.error) == (job.DONE, None)
    mill.wait(1000.0)
    assert mill.begun == [line.text for line in listing(*square(2))]
    assert sum(dist(cut.start_mm, cut.end_mm) for cut in mill.cuts if not cut.rapid) > 80


def test_a_strange_port_name_and_a_missing_mill_are_one_clear_line() -> None:
    with pytest.raises(PortError, match="usb:mdx-40a"):
        open_mdx40a("/dev/ttyUSB0")
    with pytest.raises(PortError, match=r"MDX-40A|libusb"):
        open_mdx40a()
