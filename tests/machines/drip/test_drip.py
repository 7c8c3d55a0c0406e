"""Drip feed: no byte too many after DC3, no byte lost, doubled or out of order, and no claim beyond what is known."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.drip.driver import BYTES_AFTER_STOP, DripDriver
from machines.drip.feed import ByteFeed, Pace
from machines.driver import (
    Event,
    FaultCause,
    Faulted,
    Home,
    MillState,
    Notice,
    ProgramDone,
    ProgramLine,
    Stopped,
    TrustPosition,
    Unlock,
)
from machines.errors import NotAllowedError
from machines.profile import LinkSettings
from phrases.phrase import Phrase
from tests.machines.drip.simulated_control import SimulatedControl


def program(count: int, width: int = 24) -> list[ProgramLine]:
    lines, offset = [], 0
    for n in range(1, count + 1):
        text = f"N{n}G01X{n * 0.013:.3f}Y-{n % 7}.5"[:width].encode()
        lines.append(ProgramLine(n, offset, text))
        offset += len(text) + 1
    return lines


def on_wire(lines: list[ProgramLine]) -> bytes:
    return b"%\r\n" + b"".join(line.text + b"\r\n" for line in lines) + b"%"


def run(driver: DripDriver, most_s: float = 900.0) -> list[Event]:
    """Poll until the program is done or has failed, in the driver's own time."""
    events: list[Event] = []
    while driver._port.clock() < most_s:
        events += driver.poll(1.0)
        if any(isinstance(event, ProgramDone | Faulted) for event in events):
            return events
    raise AssertionError(f"not done after {most_s} s: {driver.status}")


def connect(control: SimulatedControl, link: LinkSettings) -> DripDriver:
    driver = DripDriver(control, link)
    driver.connect()
    driver.poll(0.0)
    return driver


links = st.builds(
    LinkSettings,
    driver=st.just("drip"),
    baud=st.sampled_from([300, 1200, 2400, 4800, 9600, 19200, 38400, 115200]),
    bytesize=st.sampled_from([7, 8]),
    parity=st.sampled_from(["N", "E"]),
    stopbits=st.sampled_from([1, 2]),
    flow=st.just("none"),
)


@settings(max_examples=60, deadline=None)
@given(
    link=links,
    buffer_bytes=st.integers(96, 4096),
    latency_s=st.floats(0.0, 0.004),
    line_s=st.floats(0.0, 0.3),
    count=st.integers(1, 120),
    stop_every=st.sampled_from([0, 252]),
    ready_at_s=st.floats(0.0, 20.0),
    clock_error=st.floats(-0.015, 0.015),
)
def test_no_overrun_and_every_byte_once_in_order_for_any_line_and_any_buffer(
    link: LinkSettings,
    buffer_bytes: int,
    latency_s: float,
    line_s: float,
    count: int,
    stop_every: int,
    ready_at_s: float,
    clock_error: float,
) -> None:
    control = SimulatedControl(
        bytes_per_s=link.wire_bytes_per_s * (1 + clock_error),
        buffer_bytes=buffer_bytes,
        latency_s=latency_s,
        line_s=line_s,
        stop_every=stop_every,
        ready_at_s=ready_at_s,
    )
    lines = program(count)
    driver = connect(control, link)
    driver.start(iter(lines))
    events = run(driver)
    control.run_dry()
    assert isinstance(events[-1], ProgramDone) or ProgramDone() in events
    assert (control.overruns, control.early) == (0, 0)
    assert control.most_after_stop <= BYTES_AFTER_STOP
    assert bytes(control.received) == on_wire(lines)
    assert control.executed == [line.text for line in lines]


LINK = LinkSettings(driver="drip", baud=9600, bytesize=7, parity="E", stopbits=2, rx_bytes=256)


def slow_control(**traits: object) -> SimulatedControl:
    given_traits: dict[str, object] = {"bytes_per_s": LINK.wire_bytes_per_s, "buffer_bytes": 256, "line_s": 0.1}
    return SimulatedControl(**(given_traits | traits))  # type: ignore[arg-type]


def feeding(lines: list[ProgramLine], **traits: object) -> tuple[SimulatedControl, DripDriver]:
    """A slow control to which a program has begun to go."""
    control = slow_control(**traits)
    driver = connect(control, LINK)
    driver.start(iter(lines))
    return control, driver


def test_an_adapter_that_queues_deeply_would_overrun() -> None:
    """The law above is not vacuous: with 512 bytes under way the same control loses bytes."""
    control = slow_control()
    driver = connect(control, LINK)
    driver._pace = Pace(1e9, 512)
    driver.start(iter(program(200)))
    for _ in range(200):
        driver.poll(1.0)
    assert control.overruns > 0
    assert control.most_after_stop > BYTES_AFTER_STOP


def test_the_line_is_kept_busy_when_the_control_takes_all() -> None:
    """97 % of the wire while the control never says stop but at the tape marks."""
    lines = program(600)
    control, driver = feeding(lines, buffer_bytes=1 << 20, stop_every=0, line_s=0.0, ready_at_s=0.0, resend_s=0.0)
    run(driver)
    busy_s = len(on_wire(lines)) / LINK.wire_bytes_per_s
    assert control.now_s < busy_s / 0.97 + 1.0


def test_not_a_byte_before_the_first_dc1() -> None:
    control, driver = feeding(program(3), ready_at_s=130.0)
    events = [event for _ in range(120) for event in driver.poll(1.0)]
    assert not control.received
    assert "first DC1" in driver.status.detail
    assert [e.words for e in events if isinstance(e, Notice)] == [
        "the control has not asked for the program (DC1) for 60 s: look at its screen"
    ]
    run(driver)
    assert bytes(control.received) == on_wire(program(3))


def test_a_stop_is_obeyed_even_if_its_parity_bit_is_read_as_data() -> None:
    lines = program(80)
    control, driver = feeding(lines, parity_bit=True)
    events = run(driver)
    assert control.overruns == 0
    assert bytes(control.received) == on_wire(lines)
    assert sum(isinstance(e, Notice) and "parity" in e.words for e in events) == 1


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(1, 150), line_s=st.floats(0.01, 0.5), steps=st.integers(1, 400), planner_lines=st.integers(0, 10)
)
def test_a_line_called_executed_is_executed(count: int, line_s: float, steps: int, planner_lines: int) -> None:
    """At any moment, the lines the driver calls executed are among those the control has ended, read-ahead or not."""
    control = slow_control(line_s=line_s, planner_lines=planner_lines)
    driver = DripDriver(control, LINK, planner_blocks=planner_lines)
    driver.connect()
    driver.start(iter(program(count)))
    for _ in range(steps):
        driver.poll(0.05)
        progress = driver.progress
        assert progress.executed_line <= progress.answered_line <= progress.sent_line
        assert progress.executed_line <= max(0, len(control.executed) - 1)


@given(
    pieces=st.lists(st.integers(1, 9), min_size=60, max_size=60),
    head=st.binary(max_size=9),
    tail=st.sampled_from([b"", b"%"]),
)
def test_a_line_is_answered_with_its_last_byte_and_not_before(pieces: list[int], head: bytes, tail: bytes) -> None:
    lines = program(5)
    feed = ByteFeed(iter(lines), lambda line: line.text + b"\n", head, tail)
    text, ends, end = b"", [], len(head)
    for line in lines:
        end += len(line.text) + 1
        ends.append(end)
    for most in pieces:
        text += feed.take(most)
        feed.note_taken(len(text))
        assert feed.answered_line == sum(end <= len(text) for end in ends)
        assert feed.finished == (len(text) == ends[-1] + len(tail))
    assert (head + b"".join(line.text + b"\n" for line in lines) + tail).startswith(text)


def test_with_an_unknown_buffer_nothing_is_called_executed() -> None:
    control = slow_control()
    driver = connect(control, LinkSettings(driver="drip", baud=9600, bytesize=7, parity="E", stopbits=2))
    driver.start(iter(program(100)))
    run(driver)
    assert driver.progress.executed_line == 0
    assert driver.progress.answered_line == 100


def test_hold_stops_the_bytes_and_resume_goes_on_where_it_stopped() -> None:
    lines = program(100)
    control, driver = feeding(lines, line_s=0.0)
    for _ in range(4):
        driver.poll(0.5)
    driver.hold()
    held_at = len(control.received)
    events = [event for _ in range(20) for event in driver.poll(0.5)]
    assert len(control.received) <= held_at + BYTES_AFTER_STOP
    assert driver.status.state is MillState.HOLDING
    assert any(isinstance(e, Notice) and "256 bytes: press feed hold" in e.words for e in events)
    driver.resume()
    run(driver)
    assert bytes(control.received) == on_wire(lines)


def test_abort_says_that_the_position_is_not_known() -> None:
    control, driver = feeding(program(100))
    driver.poll(1.0)
    driver.poll(1.0)
    driver.abort()
    before = len(control.received)
    events = [event for _ in range(10) for event in driver.poll(0.5)]
    assert Stopped(position_kept=False) in events
    assert len(control.received) <= before + BYTES_AFTER_STOP
    assert driver.status.state is MillState.IDLE
    assert not driver.progress.streaming


@pytest.mark.parametrize(
    ("text", "words"),
    [(b"g01 x1.", "upper case"), (b"G01X1.\xe4", "7-bit"), (b"G01\tX1.", "7-bit"), (b"(100%)", "end the tape")],
)
def test_what_a_seven_bit_line_cannot_carry_is_refused_with_its_line(text: bytes, words: str) -> None:
    control = slow_control()
    driver = connect(control, LINK)
    driver.start(iter([*program(2), ProgramLine(3, 60, text)]))
    fault = run(driver)[-1]
    assert isinstance(fault, Faulted)
    assert fault.cause is FaultCause.PROGRAM_CHANGED
    assert words in fault.words
    assert "line 3" in fault.words
    assert text not in bytes(control.received)


def test_tape_marks_of_the_file_are_not_doubled_and_nothing_follows_the_last() -> None:
    control = slow_control(line_s=0.0)
    driver = connect(control, LINK)
    body = program(3)
    driver.start(iter([ProgramLine(0, 0, b"%"), *body, ProgramLine(4, 90, b"%")]))
    run(driver)
    assert bytes(control.received) == on_wire(body)
    behind = connect(slow_control(), LINK)
    behind.start(iter([*body, ProgramLine(4, 90, b"%"), ProgramLine(5, 92, b"G00Z5.")]))
    assert isinstance(run(behind)[-1], Faulted)


def test_a_pulled_cable_is_a_fault_and_not_an_exception() -> None:
    control, driver = feeding(program(100))
    driver.poll(1.0)
    driver.poll(1.0)
    control.unplugged = True
    (*_, fault) = driver.poll(1.0)
    assert isinstance(fault, Faulted)
    assert fault.cause is FaultCause.PORT_LOST
    assert "still executes up to 256 bytes" in fault.words
    assert driver.status.state is MillState.DISCONNECTED
    assert driver.poll(1.0) == ()


def test_a_program_that_changes_under_the_feed_stops_it() -> None:
    def changing() -> Iterator[ProgramLine]:
        yield from program(5)
        raise OSError("disk gone")

    driver = connect(slow_control(), LINK)
    driver.start(changing())
    fault = run(driver)[-1]
    assert isinstance(fault, Faulted)
    assert fault.cause is FaultCause.PROGRAM_CHANGED


def test_what_this_link_cannot_do_is_refused_and_a_lost_dc1_can_be_vouched_for() -> None:
    control = slow_control(ready_at_s=1e9)
    driver = connect(control, LINK)
    with pytest.raises(NotAllowedError, match="at the machine's panel"):
        driver.command(Home())
    with pytest.raises(NotAllowedError, match="nothing to resume"):
        driver.resume()
    driver.command(TrustPosition())
    assert driver.status.position_trusted
    driver.start(iter(program(1)))
    with pytest.raises(NotAllowedError, match="only when the link is idle"):
        driver.start(iter(program(1)))
    driver.poll(5.0)
    assert not control.received
    driver.command(Unlock())
    driver.poll(5.0)
    driver.poll(5.0)
    assert bytes(control.received) == on_wire(program(1))


def test_an_unlock_that_came_too_late_when_its_bytes_were_ready_opens_nothing() -> None:
    control, driver = feeding(program(1), ready_at_s=1e9)
    driver.poll(5.0)
    looks = iter([False, True])

    def require() -> None:
        if next(looks):
            raise NotAllowedError(Phrase("too late"))

    with pytest.raises(NotAllowedError, match="too late"):
        driver.command(Unlock(), require)
    assert [driver.poll(5.0) for _ in range(3)] == [()] * 3
    assert not control.received
    driver.command(Unlock())
    while len(control.received) < len(on_wire(program(1))):
        driver.poll(5.0)
    assert bytes(control.received) == on_wire(program(1))


def test_wake_ends_a_waiting_poll() -> None:
    control = slow_control(ready_at_s=1e9)
    driver = connect(control, LINK)
    driver.wake()
    assert driver.poll(1000.0) == ()
    assert control.now_s < 1.0
