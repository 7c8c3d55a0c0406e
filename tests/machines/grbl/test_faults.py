"""Each fault ends in a named cause, with '!' on the wire in the poll that saw the first sign, and nothing skipped."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import (
    CommandDone,
    FaultCause,
    Faulted,
    Home,
    MillState,
    Override,
    ProgramDone,
    ProgramLine,
    Stopped,
)
from machines.errors import ProgramChangedError
from machines.grbl.link import GrblOptions
from machines.grbl.session import GrblSession
from machines.grbl.states import Phase
from machines.grbl.timeouts import BANNER_S
from machines.simulated.faults import Fault, Faults
from machines.simulated.traits import GRBL_11, GRBL_11_ECHO, Traits
from tests.machines.grbl.bench import Bench, Tap, numbered, spiral

FIRST_POINT_LINE = 7  # of the spiral


def faulted(bench: Bench, lines: list[ProgramLine], within_s: float = 60.0) -> Faulted:
    """Run into the fault and through the stop; '!' must have been written by the poll that brought the event."""
    bench.start(lines)
    begin = len(bench.tap.written)
    ended = lambda: bench.of(Faulted) or bench.of(ProgramDone)  # noqa: E731
    assert bench.until(lambda: ended() or bench.state() is MillState.HELD, within_s)
    if not ended():  # a byte became '!': whoever stands at the mill lets it go on
        bench.driver.resume()
        begin = len(bench.tap.written)
        assert bench.until(ended, within_s)
    (fault,) = bench.of(Faulted)
    if fault.cause is not FaultCause.RESET:
        stop = next(at_s for at_s, data in bench.tap.written[begin:] if b"!" in data)
        assert stop == pytest.approx(fault.at_s, abs=1e-9)
        assert bench.until(lambda: bench.of(Stopped), 20.0)
    assert bench.until(lambda: bench.state() in (MillState.IDLE, MillState.ALARM), 20.0)
    return fault


def test_a_refused_block_stops_the_lines_behind_it() -> None:
    """GRBL itself would go on with what it holds; the reset from Hold clears that. (This one has no mist.)"""
    blocks = [b"G21G90G94G17", b"G1X0.5F300", b"M7", *(b"G1X%dF300" % k for k in range(2, 40)), b"M2"]
    bench = Bench(Traits(mist=False)).connected()
    fault = faulted(bench, numbered(blocks))
    assert (fault.cause, fault.line) == (FaultCause.ERROR_REPLY, 3)
    assert "error:20" in fault.words and "M7" in fault.words
    bench.pass_time(10.0)
    assert max((x for x, _, _ in bench.cut_ends()), default=0.0) < 1.5


@pytest.mark.parametrize(
    ("way_in", "fault", "said"),
    [
        ([b"G21G90G94G17", b"M7"], None, "a block of the way in 'M7' was refused"),
        ([b"G21G90G94G17"], Fault(kind="lose-reply", line=3), "after the start of the program"),
    ],
)
def test_what_has_no_line_number_is_not_called_line_0(way_in: list[bytes], fault: Fault | None, said: str) -> None:
    bench = Bench(Traits(mist=False)).connected()
    if fault is not None:
        bench.mill.arm(Faults((fault,)))
    lines = [ProgramLine(0, 0, text) for text in way_in]
    found = faulted(bench, [*lines, *numbered([b"G1X1F300", b"X2", b"M2"])], 120.0)
    assert said in found.words
    assert "line 0" not in found.words


def test_an_alarm_in_a_program_is_named_and_its_missing_reply_is_not_waited_for() -> None:
    bench = Bench(GRBL_11.with_settings({20: 1, 22: 1})).connected()
    bench.driver.command(Home())
    bench.until(lambda: bench.state() is MillState.IDLE, 200.0)
    fault = faulted(bench, numbered([b"G21G90G94G17", b"G91", b"G1X-1F300", b"G1X-900", b"G1X-1", b"M2"]))
    assert fault.cause is FaultCause.ALARM and "soft limit" in fault.words
    assert bench.driver.status.position_trusted  # a soft limit stops before it is hit


def test_a_restart_in_the_middle_skips_nothing() -> None:
    """Planner and segments hold up to 21 short blocks; the claim stays behind them."""
    for line in range(60, 200, 7):
        lines, points = spiral(250, turn_rad=0.01)
        bench = Bench(faults=(Fault(kind="power-cycle", line=line),)).connected()
        fault = faulted(bench, lines)
        assert fault.cause is FaultCause.RESET and not bench.driver.status.position_trusted
        claimed = bench.driver.progress.executed_line - FIRST_POINT_LINE + 1
        assert claimed <= bench.last_whole(points)


def test_a_restart_among_lines_that_change_nothing_skips_nothing() -> None:
    """M9, M3 and G54 again, the same point twice: answered at once, with the planner full of what is before."""
    lines, points = spiral(200, turn_rad=0.01)
    blocks = [line.text for line in lines]
    idle = [b"M9", b"G54", b"M3S10000", b"F1500", b"G1"]
    mixed = blocks[:FIRST_POINT_LINE]
    for k, block in enumerate(blocks[FIRST_POINT_LINE:]):
        mixed += [block, *(idle[: k % 6] if k % 3 else [])]
    ends = [number for number, block in enumerate(mixed, 1) if block.startswith(b"G1X")]
    for line in range(60, 300, 11):
        bench = Bench(faults=(Fault(kind="power-cycle", line=line),)).connected()
        faulted(bench, numbered(mixed))
        claimed = sum(number <= bench.driver.progress.executed_line for number in ends)
        assert claimed <= bench.last_whole(points)


def bench_that_loses(old: bytes, new: bytes) -> Bench:
    """A byte of a point is lost on the way: no error from the controller, every line answered."""

    class Dropping(Tap):
        def write(self, data: bytes) -> None:
            super().write(data.replace(old, new))

    return Bench(link=Dropping).connected()


def test_a_dropped_point_is_seen_by_the_corridor() -> None:
    """Reports leave the path."""
    bench = bench_that_loses(b"X10.5", b"X105")
    fault = faulted(bench, numbered([b"G21G90G94G17", b"G1X1F600", b"X2Y4", b"X10.5", b"X0", b"M2"]))
    assert fault.cause is FaultCause.OFF_PATH and "allowed 0.0" in fault.words
    assert max(x for x, _, _ in bench.cut_ends()) < 10.5 + 600 / 60 * (bench.options.poll_s + 0.2)


def test_a_program_that_ends_in_the_wrong_place_is_not_done() -> None:
    bench = bench_that_loses(b"X10.53", b"X10.5")
    fault = faulted(bench, numbered([b"G21G90G94G17", b"G1X10F600", b"X10.53"]))
    assert fault.cause is FaultCause.OFF_PATH and not bench.of(ProgramDone)


@pytest.mark.parametrize("mask", [0x01, 0x02, 0x04, 0x08, 0x10])
def test_with_echo_every_damaged_byte_is_stopped_before_the_cut(mask: int) -> None:
    bench = Bench(GRBL_11_ECHO, faults=(Fault(kind="flip", byte=1500, mask=mask),)).connected()
    lines, points = spiral(200)
    fault = faulted(bench, lines)
    assert fault.cause in (FaultCause.ECHO, FaultCause.ERROR_REPLY, FaultCause.REPLY_COUNT, FaultCause.STALL)
    done = bench.last_whole(points)  # fails on a foreign cut
    assert bench.driver.progress.executed_line - FIRST_POINT_LINE + 1 <= done


@pytest.mark.parametrize("kind", ["drop", "duplicate"])
def test_with_echo_dropped_and_doubled_bytes_are_stopped_too(kind: str) -> None:
    for byte in range(1500, 1530, 3):
        bench = Bench(GRBL_11_ECHO, faults=(Fault(kind=kind, byte=byte),)).connected()
        lines, points = spiral(150)
        bench.start(lines)
        assert bench.until(lambda bench=bench: bench.of(Faulted) or bench.of(ProgramDone), 60.0)
        bench.pass_time(3.0)
        bench.last_whole(points)


def test_a_program_that_changes_under_way_holds_the_mill() -> None:
    def changing():
        yield from spiral(100)[0][:50]
        raise ProgramChangedError("x.nc: changed on disk since pre-flight")

    bench = Bench().connected()
    bench.driver.start(changing())
    assert bench.until(lambda: bench.of(Faulted), 20.0)
    assert bench.of(Faulted)[0].cause is FaultCause.PROGRAM_CHANGED
    assert bench.until(lambda: bench.of(Stopped), 10.0)


@pytest.mark.parametrize("text", [b"G1X1!", b"G1X1\nG1X2", b"G1X1\x18", b"", b"G1X1~", b"G1X\xff", b"G1" + b"X" * 200])
def test_bytes_that_act_at_once_never_get_into_a_stream(text: bytes) -> None:
    bench = Bench().connected()
    begin = len(bench.tap.written)
    bench.start([ProgramLine(1, 0, b"G21"), ProgramLine(2, 4, text)])
    assert bench.until(lambda: bench.of(Stopped), 10.0)
    assert bench.of(Faulted)[0].cause is FaultCause.PROGRAM_CHANGED
    data = bench.written(begin)
    assert not text or text not in data


IDLE = b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>\r\n"
BANNER = b"Grbl 1.1h ['$' for help]\r\n"
TOLD = (b"$13=0\r\n$110=5000\r\n$111=5000\r\n$112=5000\r\nok\r\n", b"[G54:0.000,0.000,0.000]\r\nok\r\n",
        b"[GC:G0 G54 G17 G21 G90 G94]\r\nok\r\n")  # fmt: skip
IDENTITY = (b"[VER:1.1h.2019:]\r\n[OPT:V,15,128]\r\nok\r\n", *(told for told in TOLD for _ in range(2)))


def ready_session() -> GrblSession:
    session = GrblSession(GrblOptions())
    session.connect(0.0)
    session.tick(0.0)
    session.receive(IDLE, 0.1)
    for number, data in enumerate(IDENTITY):
        session.output(0.1)
        session.receive(data, 0.2 + number * 0.1)
    session.take_events()
    assert session.link.phase is Phase.READY
    return session


def streaming_session(count: int = 50) -> GrblSession:
    session = ready_session()
    session.start(iter(numbered([b"G21G90G94G17G1F600", *(b"X%d" % (k % 7) for k in range(count))])), 1.0)
    session.tick(1.0)
    session.output(1.0)
    return session


@pytest.mark.parametrize(
    ("said", "cause"),
    [
        (b"error:2\r\n", FaultCause.ERROR_REPLY),
        (b"ALARM:1\r\n", FaultCause.ALARM),
        (b"o*\r\n", FaultCause.GARBLED_REPLY),
        (b"okok\r\n", FaultCause.GARBLED_REPLY),
        (BANNER, FaultCause.RESET),
        (b"ok\r\n" * 60, FaultCause.REPLY_COUNT),
        (b"[echo: X999]\r\n", FaultCause.ECHO),
        (b"<Run|MPos:3.000,2.000,0.000|FS:600,0>\r\n", FaultCause.OFF_PATH),
        (b"<Alarm|MPos:0.000,0.000,0.000|FS:0,0>\r\n", FaultCause.ALARM),
    ],
)
def test_the_first_sign_is_answered_in_the_same_call(said: bytes, cause: FaultCause) -> None:
    session = streaming_session(20)
    session.receive(said, 1.01)
    data = session.output(1.01)
    faults = [event for event in session.take_events() if isinstance(event, Faulted)]
    assert [fault.cause for fault in faults] == [cause] and faults[0].words
    assert cause is FaultCause.RESET or data[:1] in (b"!", b"\x18")
    assert b"X" not in data and session.link.phase is not Phase.STREAMING


@pytest.mark.parametrize("stop", ["hold", "abort", "fault"])
def test_a_stop_goes_before_everything_that_waits_to_be_written(stop: str) -> None:
    session = streaming_session()
    session.tick(2.0)  # a '?' waits
    if stop == "fault":
        session.receive(b"error:2\r\n", 2.0)
    else:
        getattr(session, stop)(2.0)
    assert session.output(2.0)[:2] == b"!?"


def test_a_block_refused_while_bytes_are_taken_puts_the_hold_before_them() -> None:
    session = ready_session()
    session.start(iter(numbered([b"G21G90G94G17G1F600", b"G5X1"])), 1.0)
    session.tick(1.0)
    assert session.output(1.0)[:2] == b"!?"


def said_for(session: GrblSession, report: bytes, seconds: float, now_s: float) -> float:
    """The same report ten times a second."""
    for _ in range(int(seconds * 10)):
        now_s += 0.1
        session.tick(now_s)
        session.output(now_s)
        session.receive(report, now_s)
    return now_s


RUN = b"<Run|MPos:0.000,0.000,0.000|FS:10,0|WCO:0.000,0.000,0.000>\r\n"


def long_move() -> GrblSession:
    session = ready_session()
    session.start(iter(numbered([b"G21G90G94G17G1F10", b"X100", b"X0"])), 1.0)
    session.tick(1.0)
    session.output(1.0)
    session.receive(b"ok\r\n", 1.0)
    return session


def test_idle_with_lines_unanswered_is_a_stall_however_long_the_next_move() -> None:
    session = long_move()
    said_for(session, IDLE, 1.5, 1.0)
    assert session.link.phase is Phase.STREAMING
    said_for(session, IDLE, 2.0, 2.5)
    (fault,) = [event for event in session.take_events() if isinstance(event, Faulted)]
    assert fault.cause is FaultCause.STALL and "Idle" in fault.words


def test_idle_in_between_is_no_standing() -> None:
    """The same place for long, but not Idle: a move may be slow, or come round to the same place at every look."""
    session = long_move()
    now_s = said_for(session, IDLE, 1.0, 1.0)
    said_for(session, RUN, 20.0, now_s)
    assert session.link.phase is Phase.STREAMING


@pytest.mark.thorough
def test_counting_costs_half_a_per_cent_where_the_planner_never_covers_it() -> None:
    """As many short segments as the wire carries: nothing but the wire is slow."""
    blocks = [b"G21G90G94G17G1F3000", *(b"X%.7fY%.5f" % (0.002 * (k % 4000), 0.001 * (k % 2)) for k in range(25000))]

    def seconds() -> float:
        bench = Bench(GRBL_11.with_settings({120: 5000, 121: 5000})).connected()
        bench.start(numbered([*blocks, b"M2"]))
        begin_s = bench.mill.now_s
        assert bench.until(lambda: bench.of(ProgramDone), 300.0)
        return bench.mill.now_s - begin_s

    counted_s = seconds()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("machines.grbl.flow_control.COUNT_EVERY_S", 1e9)
        assert counted_s < 1.005 * seconds()
    assert sum(map(len, blocks)) + len(blocks) > 0.97 * 11520 * counted_s


def test_a_link_given_up_asks_for_no_more_calls() -> None:
    """A deadline in the past would make whoever polls spin, and simulated time stand still."""
    session = streaming_session()
    session.lose("cable", 2.0)
    assert session.next_deadline_s == math.inf and session.output(3.0) == b""


def test_no_reset_while_the_mill_may_move() -> None:
    """After a fault Ctrl-X waits for a report of standstill, however long it takes."""
    session, now_s = streaming_session(), 1.0
    session.receive(b"error:2\r\n", now_s)
    written = session.output(now_s)
    for _ in range(400):
        now_s += 0.05
        session.tick(now_s)
        written += session.output(now_s)
        session.receive(
            b"<Run|MPos:0.500,0.000,0.000|FS:600,0>\r\n" + b"ok\r\n<Hold:1|MPos:0.600,0.000,0.000|FS:1,0>\r\n", now_s
        )
    assert b"\x18" not in written and b"!" in written
    for _ in range(3):
        now_s += 0.05
        session.receive(b"<Hold:0|MPos:0.600,0.000,0.000|FS:0,0>\r\n", now_s)
    assert b"\x18" in session.output(now_s)


def test_an_error_before_the_banner_answers_nothing() -> None:
    session = GrblSession()
    session.connect(0.0)
    session.receive(b"\r\nerror:7\r\n" + BANNER + IDLE, 0.1)
    for number, data in enumerate(IDENTITY):
        session.output(0.1)
        session.receive(data, 0.2 + number * 0.1)
    assert session.link.phase is Phase.READY and session.link.epoch == 1


REPORTS = ["Hold:0", "Hold:1", "Run", "Door:0", "Sleep", "Check", "Jog", "Tool", "Home", "Idle", "Alarm"]
SAID = [
    *(b"<%s|MPos:0.0,0.0,0.0>\r\n" % name.encode() for name in REPORTS),
    *(b"ok\r\n", b"error:2\r\n", b"error:9\r\n", b"ALARM:1\r\n", b"ALARM:3\r\n", BANNER, IDLE, *IDENTITY),
    *(b"[MSG:x]\r\n", b"[echo: X1]\r\n", b"<Run|MPos:5.0,9.0,0.0>\r\n", b"\xff\xfe\n", b"[PRB:0,0,0:1]\r\n"),
]
PIECES = st.one_of(st.binary(max_size=12), st.sampled_from(SAID))


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(PIECES, st.sampled_from([0.0, 0.01, 0.3, 3.0, 20.0])), max_size=40), st.booleans())
def test_no_bytes_and_no_times_break_the_session(script: list[tuple[bytes, float]], streaming: bool) -> None:
    """Total: whatever comes whenever. The window holds, and nothing that starts motion is written by itself."""
    session = streaming_session() if streaming else ready_session()
    now_s = 1.0
    for data, pause_s in script:
        now_s += pause_s
        session.tick(now_s)
        session.receive(data, now_s)
        out = session.output(now_s)
        assert set(out) <= set(b"?!\x18$IG#XYZF0123456789.-\n")
        assert session.streamer.progress.bytes_in_flight <= session.streamer.window_bytes
        assert session.next_deadline_s >= 0.0
        assert session.reporter.status.state in MillState and session.reporter.facts
        assert session.reporter.protections is not None
        session.take_events()


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(1, 12), min_size=1, max_size=200))
def test_chunks_of_replies_change_nothing(sizes: list[int]) -> None:
    said = b"ok\r\n" * 3 + b"<Run|MPos:1.000,0.000,0.000|FS:600,0>\r\n" + b"ok\r\n" * 5 + b"[MSG:hello]\r\nok\r\n" * 3
    whole, pieces = streaming_session(), streaming_session()
    whole.receive(said, 1.1)
    start = 0
    for size in [*sizes, len(said)]:
        pieces.receive(said[start : start + size], 1.1)
        start += size
    assert pieces.streamer.progress == whole.streamer.progress
    assert pieces.output(1.1) == whole.output(1.1)
    assert pieces.take_events() == whole.take_events()


def test_a_line_that_writes_settings_is_under_way_alone() -> None:
    """While the EEPROM is written the controller hears nothing: no counted line may be before or behind it."""
    session = ready_session()
    session.start(iter(numbered([b"G21G90G94G17G1F600", b"X1", b"G10L2P2X0", b"X2", b"X3"])), 1.0)
    session.link.urgent.clear()
    written = []
    for _ in range(4):
        written.append(session.output(1.0).replace(b"?", b""))
        session.receive(b"ok\r\n" * max(1, written[-1].count(b"\n")), 1.0)
    assert written[:3] == [b"G21G90G94G17G1F600\nX1\n", b"G10L2P2X0\n", b"X2\nX3\n"]


def test_one_idle_report_is_no_proof_of_standstill() -> None:
    """It may have been made before the next queued line began; a reset then would be a reset in motion."""
    session = streaming_session()
    session.receive(b"error:2\r\n" + IDLE, 1.0)
    assert session.output(1.0).replace(b"?", b"") == b"!"


def test_a_lost_hold_is_sent_again_and_a_cycle_start_is_believed() -> None:
    session, run = streaming_session(), b"<Run|MPos:0.000,0.000,0.000|FS:600,0>\r\n"
    session.hold(1.0)
    assert session.output(1.0).startswith(b"!")
    session.receive(run, 1.6)
    assert b"!" in session.output(1.6)
    session.receive(run.replace(b"Run", b"Hold:0"), 1.8)
    assert session.reporter.state is MillState.HELD
    session.receive(run, 2.5)
    assert session.reporter.state is MillState.RUN and b"!" not in session.output(2.5)


def test_a_hold_asked_for_while_the_link_was_away_is_carried_out_on_return() -> None:
    session = GrblSession()
    session.hold(0.0)
    session.connect(0.1)
    session.receive(b"<Run|MPos:0.000,0.000,0.000|FS:600,0>\r\n", 0.2)
    assert session.output(0.2).startswith(b"!")


@pytest.mark.parametrize("asked_at_s", [0.0, 0.15])
def test_an_abort_asked_for_while_the_link_was_away_is_carried_out_on_return(asked_at_s: float) -> None:
    """Before the link is opened, and before anybody has answered on it."""
    session = GrblSession()
    if asked_at_s < 0.1:
        session.abort(asked_at_s)
    session.connect(0.1)
    if asked_at_s > 0.1:
        session.abort(asked_at_s)
        session.output(asked_at_s)
    session.receive(RUN, 0.2)
    assert session.output(0.2).startswith(b"!") and session.link.phase is Phase.STOPPING


def test_without_a_banner_after_a_reset_the_mill_is_asked_again_whether_it_stands() -> None:
    """The byte was lost, or the banner: the mill may run, so '!' goes first, and a reset only from standstill."""
    held = b"<Hold:0|MPos:0.000,0.000,0.000|FS:0,0>\r\n"
    session = streaming_session()
    session.receive(b"error:2\r\n" + 2 * held, 1.0)
    assert b"\x18" in session.output(1.0)
    now_s, written = 1.0, b""
    while now_s < 1.0 + BANNER_S + 0.5:
        now_s += 0.05
        session.tick(now_s)
        written += session.output(now_s)
    assert written.count(b"!") >= 1 and b"\x18" not in written and b"?" in written.partition(b"!")[2]
    session.receive(2 * held, now_s)
    assert b"\x18" in session.output(now_s)


def test_an_alarm_that_no_banner_follows_does_not_end_the_handshake() -> None:
    session = GrblSession()
    session.connect(0.0)
    session.receive(IDLE, 0.1)
    session.output(0.1)
    session.receive(b"ALARM:4\r\n", 0.1)
    session.tick(0.2)
    assert b"?" in session.output(0.2)
    session.receive(IDLE.replace(b"Idle", b"Alarm"), 0.3)
    for number, data in enumerate(IDENTITY):
        session.output(0.4)
        session.receive(data, 0.4 + number * 0.1)
    assert session.link.phase is Phase.READY and session.reporter.state is MillState.ALARM


@pytest.mark.parametrize("said", [b"error:2\r\n", BANNER])
def test_an_override_under_way_ends_with_the_program_and_says_so(said: bytes) -> None:
    session, override = streaming_session(), Override("feed", 120)
    session.command(override, 1.0)
    session.receive(said, 1.0)
    (done,) = [event for event in session.take_events() if isinstance(event, CommandDone)]
    assert done.command is override and done.failure
