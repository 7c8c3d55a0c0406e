"""A stop is the last word: nothing that starts motion leaves the session after it until a person asks for something."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from machines.driver import (
    CommandDone,
    Faulted,
    Home,
    Jog,
    JogCancel,
    MillState,
    Notice,
    Override,
    ProbeCorner,
    ProbeZ,
    ProgramDone,
    Reset,
    SendBlock,
    SetZero,
    Stopped,
    TrustPosition,
    Unlock,
)
from machines.errors import NotAllowedError
from machines.grbl.states import FROM_EVERYWHERE, MOVES, Phase, may_move
from machines.simulated.traits import GRBL_11
from tests.machines.grbl.bench import Bench, numbered, spiral

CORNER = {"depth_mm": 10, "plate_mm": 1, "wall_x_mm": 1, "wall_y_mm": 1, "cutter_radius_mm": 1, "margin_mm": 8}
# What a person may do; "hold", "abort" and "jog-cancel" are stops. "write" lets bytes leave, "hear" brings answers.
ORDERS: dict[str, Callable[[Bench], None]] = {
    "jog": lambda b: b.driver.command(Jog((0.5, 0.0, 0.0), 600.0)),
    "probe": lambda b: b.driver.command(ProbeZ(depth_mm=10.0, feed_mm_per_min=900.0)),
    "corner": lambda b: b.driver.command(ProbeCorner(**CORNER)),
    "home": lambda b: b.driver.command(Home()),
    "zero": lambda b: b.driver.command(SetZero("Z")),
    "block": lambda b: b.driver.command(SendBlock("G1X1F600")),
    "unlock": lambda b: b.driver.command(Unlock()),
    "reset": lambda b: b.driver.command(Reset()),
    "override": lambda b: b.driver.command(Override("feed", 90)),
    "start": lambda b: b.driver.start(iter(spiral(60)[0])),
    "resume": lambda b: b.driver.resume(),
}
STOPS: dict[str, Callable[[Bench], None]] = {
    "hold": lambda b: b.driver._session.hold(b.mill.now_s),  # without the driver's own write
    "abort": lambda b: b.driver._session.abort(b.mill.now_s),
    "jog-cancel": lambda b: b.driver.command(JogCancel()),
}
QUESTIONS = (b"$I", b"$$", b"$#", b"$G", b"")


def write(bench: Bench) -> None:
    session, now_s = bench.driver._session, bench.mill.now_s
    data = session.output(now_s)
    if data:
        bench.tap.write(data)


def hear(bench: Bench) -> None:
    session = bench.driver._session
    session.receive(bench.tap.read(0.02), bench.mill.now_s)
    bench.events += session.take_events()


TIMES: dict[str, Callable[[Bench], None]] = {
    "write": write,
    "hear": hear,
    "look": lambda b: b.driver._session.tick(b.mill.now_s),
    "pass": lambda b: b.pass_time(0.3),
}
NAMES = st.sampled_from([*ORDERS, *STOPS, *STOPS, *TIMES, *TIMES])


@settings(max_examples=250, deadline=None)
@given(st.lists(NAMES, max_size=40), st.booleans())
@example(["start", "pass", "hold", "pass", "resume", "hold", "write", "pass", "pass"], False)
@example(["jog", "hold", "pass", "write"], False)
@example(["jog", "jog-cancel", "pass"], False)
@example(["probe", "pass", "hold", "pass", "pass", "pass"], False)
@example(["corner", "pass", "hold", "pass", "pass", "pass"], False)
@example(["home", "hold", "pass"], True)
@example(["start", "pass", "hold", "pass", "resume", "abort", "pass"], False)
def test_after_a_stop_nothing_that_starts_motion_is_written_unasked(script: list[str], homing: bool) -> None:
    bench = Bench(GRBL_11.with_settings({22: float(homing)})).connected()
    stopped, mark = "", 0
    for name in script:
        if name in STOPS:
            if name == "jog-cancel" and bench.driver._session.streamer.stream is not None:
                continue  # is for jogs; a program goes on
            with contextlib.suppress(NotAllowedError):
                STOPS[name](bench)
                stopped, mark = name, len(bench.tap.written)
        elif name in ORDERS:
            before = bench.driver._session.link.urgent[:], bench.driver._session.link.text[:]
            try:
                ORDERS[name](bench)
            except NotAllowedError:
                assert before == (bench.driver._session.link.urgent, bench.driver._session.link.text)
            else:
                stopped = ""
        else:
            TIMES[name](bench)
        if stopped:
            written = bench.written(mark)
            assert b"~" not in written and b"\xa3" not in written, (stopped, written)
            if stopped != "jog-cancel":  # which ends a jog; a probe's next line may follow
                for line in written.translate(None, bytes(range(0x80, 0x100)) + b"?!\x18").split(b"\n"):
                    assert line in QUESTIONS, (stopped, written)


def test_hold_is_the_last_word_before_a_waiting_resume() -> None:
    """Seen on a real mill: '!' was put before a '~' that waited, "!~" went out, and the mill ran."""
    bench = Bench().connected()
    bench.start(spiral(300)[0])
    bench.pass_time(2.0)
    bench.hold()
    reached = bench.mill.recording.count
    session = bench.driver._session  # the driver itself writes it at once
    session.resume(bench.mill.now_s)
    bench.driver.hold()
    bench.pass_time(3.0)
    assert bench.mill.recording.count == reached and bench.state() is MillState.HELD
    bench.driver.resume()
    assert bench.until(lambda: bench.of(ProgramDone), 120.0) and not bench.of(Faulted)


def test_a_report_from_before_a_hold_confirms_nothing() -> None:
    """Resumed and held again at once: the '!' is lost, and the answer to a '?' before it still says Hold."""
    bench = Bench().connected()
    bench.start(spiral(300)[0])
    bench.pass_time(1.0)
    bench.hold()
    session, now_s = bench.driver._session, bench.mill.now_s
    session.link.poll_at_s = now_s
    session.tick(now_s)
    session.resume(now_s)
    assert bytes(session.link.urgent) == b"?~"
    write(bench)
    session.hold(now_s)
    session.link.urgent.clear()  # its wire is cut
    bench.pass_time(3.0)
    assert bench.state() is MillState.HELD


def test_a_jog_cancelled_before_the_controller_has_read_its_line_ends_all_the_same() -> None:
    """The byte that ends a jog acts on arrival, and is forgotten where none runs yet."""
    bench = Bench().connected()
    bench.driver.command(Jog((50.0, 0.0, 0.0), 600.0))
    bench.driver.command(JogCancel())
    assert bench.until(lambda: bool(bench.of(CommandDone)), 3.0)
    bench.pass_time(3.0)
    assert bench.state() is MillState.IDLE
    assert abs(bench.driver.status.machine_mm[0]) < 5.0


def test_a_probe_that_was_held_sets_no_zero_and_does_not_go_back_up() -> None:
    bench = Bench().connected()
    bench.driver.command(ProbeZ(depth_mm=10.0, feed_mm_per_min=300.0))
    bench.pass_time(0.5)
    bench.hold()
    assert "hold" in bench.of(CommandDone)[0].failure
    with pytest.raises(NotAllowedError, match=r"G38\.2.*reset"):
        bench.driver.resume()
    bench.driver.command(Reset())
    assert bench.until(lambda: bench.of(Stopped) and bench.state() is MillState.IDLE, 5.0)
    assert bench.of(Stopped)[-1] == Stopped(position_kept=True)
    assert max(segment.end[2] for segment in bench.mill.recording.segments) < 0.0
    bench.driver.command(Jog((0.0, 0.0, 1.0), 600.0))
    assert bench.until(lambda: len(bench.of(CommandDone)) == 3, 10.0) and not bench.of(CommandDone)[-1].failure


def begin_program(bench: Bench) -> None:
    lines, _ = spiral(300)
    bench.start(lines)


WHAT_IS_HELD: dict[str, Callable[[Bench], None]] = {
    "program": begin_program,
    "end of a program": lambda bench: bench.driver.start(iter(numbered([b"G21G90G94", b"G1X3F600"]))),
    "line": lambda bench: bench.driver.command(SendBlock("G1X9F300")),
    "short line": lambda bench: bench.driver.command(SendBlock("G1X1.1F600")),
    "probe": lambda bench: bench.driver.command(ProbeZ(depth_mm=10.0, feed_mm_per_min=200.0)),
}


@pytest.mark.parametrize("what", WHAT_IS_HELD)
@pytest.mark.parametrize("after_s", [0.0, 1.0, 20.0])
def test_a_cycle_start_at_the_machine_after_our_hold_is_noticed_and_said(what: str, after_s: float) -> None:
    """Nobody believes that a mill is held that runs; even where it has stopped again before the next report."""
    bench = Bench().connected()
    WHAT_IS_HELD[what](bench)
    assert bench.until(lambda: bench.mill.firmware.stepper.moving and bench.mill.firmware.stepper.speed > 3.0, 10.0)
    bench.hold()
    bench.pass_time(after_s)
    said = len(bench.of(Notice))
    bench.mill.press("start")
    held_s = 0.0
    for _ in range(50):
        before_s = bench.mill.now_s
        bench.pass_time(0.05)
        if bench.mill.firmware.state == "Run" and bench.state() in (MillState.HELD, MillState.HOLDING):
            held_s += bench.mill.now_s - before_s
    assert held_s < 1.0
    assert bench.state() in (MillState.RUN, MillState.IDLE)
    words = [event.words for event in bench.of(Notice)[said:]]
    assert sum("cycle start was pressed" in one for one in words) == 1, words


def test_our_own_resume_is_no_cycle_start_at_the_machine() -> None:
    bench = Bench().connected()
    begin_program(bench)
    bench.pass_time(2.0)
    for _ in range(3):
        bench.hold()
        bench.driver.resume()
        assert bench.until(lambda: bench.state() is MillState.RUN, 5.0)
        bench.pass_time(1.0)
    assert not [event for event in bench.of(Notice) if "cycle start" in event.words]


def test_a_hold_during_the_handshake_does_not_end_the_link() -> None:
    bench = Bench()
    bench.driver.connect()
    bench.until(lambda: b"$$" in bench.written(), 5.0)
    bench.driver.hold()
    bench.pass_time(60.0)
    assert bench.state() is MillState.HELD
    bench.driver.resume()
    assert bench.until(lambda: bench.state() is MillState.IDLE, 5.0)


def test_a_hold_asked_for_in_an_alarm_does_not_colour_later_jogs() -> None:
    bench = Bench(GRBL_11.with_settings({22: 1.0})).connected()
    bench.driver.hold()
    bench.pass_time(0.5)
    bench.driver.command(Unlock())
    assert bench.until(lambda: bench.state() is MillState.IDLE, 3.0)
    bench.driver.command(Jog((20.0, 0.0, 0.0), 600.0))
    bench.pass_time(1.0)
    assert bench.state() is MillState.JOG


@pytest.mark.parametrize("again_s", [0.01, 0.033])
def test_a_resume_key_held_down_postpones_no_poll(again_s: float) -> None:
    """Key repeat on a held mill: each press put the next '?' off by 0.05 s, until the link was given up."""
    bench = Bench().connected()
    bench.start(spiral(300)[0])
    bench.pass_time(1.0)
    bench.hold()
    bench.mill.press("door")  # stays held whatever is pressed
    bench.pass_time(1.0)
    bench.mill.press("close-door")
    bench.pass_time(0.5)
    reports = bench.driver._session.link.view.reports
    end_s = bench.mill.now_s + 3.0
    while bench.mill.now_s < end_s:
        with contextlib.suppress(NotAllowedError):
            bench.driver._session.resume(bench.mill.now_s)
            bench.driver._session.link.urgent = bench.driver._session.link.urgent.replace(b"~", b"")  # its wire is cut
        bench.events += bench.driver.poll(again_s)
    assert bench.driver._session.link.view.reports > reports + 20
    assert not bench.of(Faulted)


def test_an_order_refused_leaves_nothing_behind() -> None:
    bench = Bench().connected()
    bench.start(numbered([b"G21G90G94G17", b"G1X50F300", b"M2"]))
    bench.pass_time(1.0)
    with pytest.raises(NotAllowedError):
        bench.driver.resume()
    assert bench.driver._session.link.urgent.count(b"~") == 0


@pytest.mark.parametrize("later_s", [0.0, 0.01, 0.25, 1.0])
@pytest.mark.parametrize("between", [None, "?"])
def test_an_abort_after_a_hold_of_an_idle_mill_leaves_it_idle(later_s: float, between: str | None) -> None:
    """The '!' of the hold is on its way: what the mill said before it is no proof that it stays idle."""
    bench = Bench().connected()
    bench.driver.command(TrustPosition())
    if between:  # a report from before the hold is still to come
        bench.driver._session.link.poll_at_s = bench.mill.now_s
        write(bench)
    bench.driver.hold()
    assert bench.state() is MillState.HOLDING
    bench.pass_time(later_s)
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 5.0)
    bench.pass_time(3.0)
    assert bench.state() is MillState.IDLE and bench.mill.firmware.state == "Idle"
    assert bench.of(Stopped) == [Stopped(position_kept=True)]


def test_a_hold_that_was_lost_on_an_idle_mill_ends_with_the_next_report() -> None:
    bench = Bench().connected()
    bench.driver._session.hold(bench.mill.now_s)
    bench.driver._session.link.urgent.clear()  # its wire is cut
    bench.pass_time(1.0)
    assert bench.state() is MillState.IDLE


@pytest.mark.parametrize("phase", ["streaming", "stopping", "clearing", "hailing", "identifying", "ready"])
@pytest.mark.parametrize("first", ["hold", "abort"])
def test_an_abort_asked_for_in_any_phase_of_another_stop_leaves_no_mill_held(phase: str, first: str) -> None:
    """Its '!' leaves at once, from any thread: it may reach a controller that has just been reset."""
    bench = Bench().connected()
    begin_program(bench)
    bench.pass_time(1.0)
    if first == "hold":
        bench.hold()
    if phase != "streaming":
        bench.driver.abort()
        assert bench.until(lambda: bench.driver._session.link.phase.value == phase, 5.0)
    assert bench.driver.urge("abort")
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 5.0)
    bench.pass_time(5.0)
    assert bench.state() is MillState.IDLE and bench.mill.firmware.state == "Idle", bench.driver.status


def test_every_phase_is_in_the_table_and_can_be_left_and_reached() -> None:
    assert set(MOVES) == set(Phase)
    reached = set().union(*MOVES.values()) | FROM_EVERYWHERE
    assert reached == set(Phase)


def test_a_program_starts_only_from_ready_and_a_stop_ends_in_a_reset_or_a_new_epoch() -> None:
    assert [phase for phase in Phase if may_move(phase, Phase.STREAMING)] == [Phase.READY]
    assert MOVES[Phase.STOPPING] == {Phase.CLEARING}
