"""The driver against the simulated mill, in simulated time: programs, holds, aborts, commands, handshakes."""

from __future__ import annotations

import pytest

from machines.driver import (
    CheckMode,
    CommandDone,
    FaultCause,
    Faulted,
    Home,
    Jog,
    JogCancel,
    MillState,
    Override,
    ProbeZ,
    ProgramDone,
    ReadSettings,
    Reset,
    Restarted,
    SendBlock,
    SetZero,
    Stopped,
    TrustPosition,
    Unlock,
)
from machines.errors import NotAControllerError, NotAllowedError
from machines.grbl.driver import GrblDriver
from machines.grbl.settings import is_parser_state
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, Tap, numbered, spiral


@pytest.mark.parametrize("traits", [GRBL_11, GRBL_11_ECHO, GRBLHAL, FLUIDNC], ids=["1.1", "echo", "hal", "fluidnc"])
def test_the_path_cut_is_the_path_programmed(traits: Traits) -> None:
    bench = Bench(traits).connected()
    lines, points = spiral(500)
    bench.run(lines, 120.0)
    assert bench.last_whole(points) == 500
    assert bench.driver.progress.executed_line == len(lines)
    assert bench.most_in_flight <= traits.rx_advertised - 1 and bench.mill.serial.lost_overflow == 0
    assert ("echo" in "".join(bench.driver.protections)) == traits.echo
    assert "corridor" in "".join(bench.driver.protections)


def test_modes_that_a_program_leaves_hold_for_the_next_one() -> None:
    """The controller keeps G91; held against a path in G90 the mill would be off it."""
    bench = Bench().connected()
    for number, blocks in enumerate(([b"G21G91G94G17", b"G1X1F600"], [b"G1X1F600"]), 1):
        bench.start(numbered(blocks))
        assert bench.until(lambda count=number: len(bench.of(ProgramDone)) == count or bench.of(Faulted))
    assert not bench.of(Faulted), bench.of(Faulted)
    assert bench.driver.status.work_mm == pytest.approx((2.0, 0.0, 0.0), abs=0.006)


def test_protections_say_what_will_be_before_and_what_is_while_a_program_runs() -> None:
    bench = Bench(GRBL_11_ECHO.with_settings({20: 1, 22: 1})).connected()
    bench.driver.command(Unlock())
    bench.until(lambda: bench.state() is MillState.IDLE)
    before = bench.driver.protections
    assert "while a program runs: reported positions" in before[1] and "corridor 0.017 mm" in before[1]
    assert before[0].startswith("echo") and "soft limits" in before[2]
    bench = Bench().connected()
    bench.start(spiral(300)[0])
    assert not bench.driver.protections  # nothing was compared yet
    bench.until(lambda: bench.driver.progress.executed_line > 20)
    assert bench.driver.protections[0].startswith("reported positions are held against the path 10 times a second")
    assert bench.until(lambda: bench.of(ProgramDone))
    assert bench.driver.protections[0].startswith("while a program runs")
    bench.driver.command(CheckMode(on=True))
    bench.until(lambda: bench.state() is MillState.CHECK)
    assert not bench.driver.protections


def test_what_was_written_is_the_program_and_realtime_bytes_only() -> None:
    bench = Bench().connected()
    begin = len(bench.tap.written)
    lines, _ = spiral(100)
    bench.run(lines)
    data = bench.written(begin)
    assert data.replace(b"?", b"") == b"".join(line.text + b"\n" for line in lines)


def test_the_wire_never_has_more_than_twelve_milliseconds_waiting() -> None:
    bench = Bench(GRBLHAL).connected()
    begin = len(bench.tap.written)
    bench.run(spiral(300)[0])
    empty_s = 0.0
    for at_s, data in bench.tap.written[begin:]:
        empty_s = max(empty_s, at_s) + len(data) / 11520.0
        assert empty_s - at_s < 0.012


def test_hold_and_resume_in_the_middle() -> None:
    bench = Bench().connected()
    lines, points = spiral(300)
    bench.start(lines, past_line=100)
    bench.driver.hold()
    assert bench.tap.written[-1][1].startswith(b"!")  # written at once, not at the next poll
    assert bench.until(lambda: bench.state() is MillState.HELD, 2.0)
    reached = len(bench.cut_ends())
    bench.pass_time(30.0)
    assert len(bench.cut_ends()) == reached and not bench.of(Faulted)  # a hold is neither a fault nor a stall
    bench.driver.resume()
    assert bench.until(lambda: bench.of(ProgramDone))
    assert bench.last_whole(points) == 300


def test_a_hold_from_a_button_is_neither_fault_nor_stall() -> None:
    bench = Bench().connected()
    lines, points = spiral(200)
    bench.start(lines, past_line=60)
    bench.mill.press("hold")
    assert bench.until(lambda: bench.state() is MillState.HELD, 2.0)
    bench.pass_time(20.0)
    bench.mill.press("start")
    assert bench.until(lambda: bench.of(ProgramDone) or bench.of(Faulted))
    assert bench.last_whole(points) == 200


def test_abort_holds_first_then_clears_and_keeps_the_position() -> None:
    bench = Bench().connected()
    bench.driver.command(TrustPosition())
    lines, points = spiral(300)
    bench.start(lines, past_line=100)
    begin = len(bench.tap.written)
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped), 5.0)
    assert bench.of(Stopped) == [Stopped(position_kept=True)]
    stops = bench.written(begin).replace(b"?", b"")
    assert stops.partition(b"$")[0] == b"!\x18"
    assert bench.until(lambda: bench.state() is MillState.IDLE, 5.0)
    done = bench.last_whole(points)
    assert 0 <= 6 + done - bench.driver.progress.executed_line <= 22
    bench.pass_time(5.0)
    assert bench.last_whole(points) == done and bench.driver.status.position_trusted


def test_a_program_stop_waits_for_a_person() -> None:
    blocks = [b"G21G90G94G17", b"G1X1F600", b"M0", b"G1X2", b"M2"]
    bench = Bench().connected()
    bench.start(numbered(blocks))
    assert bench.until(lambda: bench.state() is MillState.TOOL, 10.0)
    bench.pass_time(60.0)
    assert not bench.of(Faulted) and bench.state() is MillState.TOOL
    bench.driver.resume()
    assert bench.until(lambda: bench.of(ProgramDone), 10.0)


def test_offsets_written_by_a_program_are_sent_alone() -> None:
    blocks = [b"G21G90G94G17", b"G1X1F600", b"G10L2P2X0Y0Z0", b"G1X2", b"G1X3", b"M2"]
    bench = Bench().connected()
    bench.run(numbered(blocks), 30.0)
    assert not bench.of(Faulted) and bench.mill.serial.lost_deaf == 0


def test_inch_reports_are_followed_in_mm() -> None:
    bench = Bench(GRBL_11.with_settings({13: 1})).connected()
    lines, points = spiral(200)
    bench.run(lines)
    assert not bench.of(Faulted) and bench.last_whole(points) == 200
    bench.pass_time(1.0)
    assert bench.driver.status.work_mm[2] == pytest.approx(5.0, abs=0.003)


def test_the_handshake_never_resets_and_never_moves() -> None:
    bench = Bench(GRBLHAL).connected()
    data = bench.written()
    assert set(data.replace(b"?", b"").split(b"\n")) == {b"$I", b"$$", b"$#", b"$G", b""}
    assert bench.driver.settings.rx_bytes == 1024 and bench.driver.settings.planner_blocks == 100


def test_a_locked_mill_is_alarm_until_unlocked_or_homed() -> None:
    bench = Bench(Traits(homing=True)).connected()
    assert bench.state() is MillState.ALARM
    with pytest.raises(NotAllowedError, match="alarm"):
        bench.start(())
    assert bench.do(Home(), 200.0).failure == ""
    assert bench.until(lambda: bench.state() is MillState.IDLE, 5.0) and bench.driver.status.position_trusted


def test_unlocking_does_not_make_a_position_trusted() -> None:
    bench = Bench(Traits(homing=True)).connected()
    bench.driver.command(Unlock())
    assert bench.until(lambda: bench.state() is MillState.IDLE, 5.0)
    assert not bench.driver.status.position_trusted


def test_a_reset_from_outside_ends_the_epoch_and_the_program() -> None:
    bench = Bench().connected()
    bench.driver.command(TrustPosition())
    bench.start(spiral(300)[0], past_line=50)
    epoch = bench.driver.status.epoch
    bench.mill.power_cycle()
    assert bench.until(lambda: bench.of(Faulted), 5.0)
    assert bench.of(Faulted)[0].cause is FaultCause.RESET and bench.driver.status.epoch == epoch + 1
    assert bench.until(lambda: bench.state() is MillState.IDLE, 5.0)
    assert not bench.driver.status.position_trusted and not bench.driver.progress.streaming


def test_a_pulled_cable_is_a_state_not_an_exception() -> None:
    bench = Bench().connected()
    bench.start(spiral(300)[0], past_line=50)
    bench.mill.unplug()
    assert bench.until(lambda: bench.of(Faulted), 5.0)
    assert bench.of(Faulted)[0].cause is FaultCause.PORT_LOST and bench.state() is MillState.DISCONNECTED
    bench.driver.hold()  # allowed at any time
    with pytest.raises(NotAllowedError):
        bench.driver.resume()


@pytest.mark.parametrize("percent", [10, 87, 100, 133, 200])
def test_feed_override_reaches_any_percentage_while_streaming(percent: int) -> None:
    bench = Bench().connected()
    bench.start(spiral(2000)[0], past_line=20)
    assert bench.do(Override("feed", percent)).failure == "" and bench.driver.status.overrides[0] == percent
    assert not bench.of(Faulted)


def test_an_override_ends_once_and_a_stop_ends_it() -> None:
    bench = Bench().connected()
    bench.start(spiral(2000)[0])
    bench.pass_time(1.0)
    bench.driver.command(Override("feed", 120))
    bench.pass_time(5.0)
    bench.driver.command(Override("feed", 200))
    bench.driver.abort()
    assert bench.until(lambda: bench.of(Stopped) and bench.state() is MillState.IDLE, 10.0)
    bench.pass_time(3.0)
    assert [done.failure for done in bench.of(CommandDone)] == ["", "aborted"]
    assert bench.driver.status.overrides[0] == 100


def test_rapid_override_and_refused_values() -> None:
    bench = Bench().connected()
    bench.do(Override("rapid", 25))
    assert bench.driver.status.overrides[1] == 25
    for what, percent in (("rapid", 30), ("feed", 9), ("feed", 201), ("speed", 100)):
        with pytest.raises(NotAllowedError, match=r"override"):
            bench.driver.command(Override(what, percent))


def test_jog_arrives_and_can_be_cancelled() -> None:
    bench = Bench().connected()
    bench.do(Jog((5.0, 0.0, -2.0), 600.0))
    assert bench.driver.status.machine_mm == pytest.approx((5.0, 0.0, -2.0), abs=0.005)
    bench.driver.command(Jog((50.0, 0.0, 0.0), 600.0))
    assert bench.until(lambda: bench.state() is MillState.JOG, 2.0)
    bench.driver.command(JogCancel())
    assert bench.until(lambda: bench.state() is MillState.IDLE, 3.0)
    assert bench.driver.status.machine_mm[0] < 40.0


def test_probing_sets_the_contact_to_the_height_of_the_plate() -> None:
    """The surface is at physical Z -5; the tool overshoots while braking, the zero must not."""
    bench = Bench().connected()
    done = bench.do(ProbeZ(depth_mm=10.0, feed_mm_per_min=900.0, plate_mm=1.5, retract_mm=3.0))
    assert done.failure == "" and done.answer["contact_machine_mm"][2] == pytest.approx(-5.0, abs=0.02)
    bench.pass_time(2.0)
    status = bench.driver.status
    assert status.work_offset_mm[2] == pytest.approx(-6.5, abs=0.02)


def test_a_probe_that_meets_nothing_sets_nothing() -> None:
    bench = Bench(Traits(probe_surface_mm=None)).connected()
    assert "ALARM:5" in bench.do(ProbeZ(depth_mm=3.0, feed_mm_per_min=100.0)).failure


def test_zero_setting_is_read_back() -> None:
    bench = Bench().connected()
    bench.do(Jog((5.0, 4.0, -2.0), 600.0))
    assert bench.do(SetZero("XYZ")).answer["offsets"]["G54"] == pytest.approx([5.0, 4.0, -2.0], abs=0.005)
    bench.pass_time(2.0)
    assert bench.driver.status.work_mm == pytest.approx((0.0, 0.0, 0.0), abs=0.005)
    assert bench.driver.status.position_trusted


def test_a_dry_run_moves_nothing_and_leaves_check_mode() -> None:
    bench = Bench().connected()
    bench.driver.command(CheckMode(on=True))
    assert bench.until(lambda: bench.state() is MillState.CHECK, 5.0)
    lines, _ = spiral(200)
    bench.run(lines, 30.0)
    assert not bench.of(Faulted) and not bench.mill.recording.segments
    bench.driver.command(CheckMode(on=False))
    assert bench.until(lambda: bench.of(Restarted) and bench.state() is MillState.IDLE, 10.0)


def test_settings_are_answered_as_plain_data() -> None:
    bench = Bench().connected()
    answer = bench.do(ReadSettings()).answer
    assert answer["settings"]["values"]["110"].startswith("5000") and "G54" in answer["offsets"]
    assert "G21" in answer["parser_state"]


def test_a_typed_block_is_refused_by_the_controller_in_words() -> None:
    bench = Bench().connected()
    assert "error:20 (G or M code not supported" in bench.do(SendBlock("G81 X1")).failure
    for text in ("G1 X1!", "", "$H", "G1\nX1", "é"):
        with pytest.raises(NotAllowedError):
            bench.driver.command(SendBlock(text))


def test_commands_that_do_not_go_with_a_program_are_refused() -> None:
    bench = Bench().connected()
    bench.start(spiral(300)[0], past_line=20)
    for command in (Home(), Unlock(), Reset(), Jog(), SetZero(), SendBlock("G0X0"), ReadSettings(), CheckMode(on=True)):
        with pytest.raises(NotAllowedError, match=r"run|under way"):
            bench.driver.command(command)
    with pytest.raises(NotAllowedError):
        bench.start(())
    assert bench.until(lambda: bench.of(ProgramDone)) and not bench.of(Faulted)


def test_reset_when_idle_is_a_new_epoch_with_the_position_kept() -> None:
    bench = Bench().connected()
    bench.driver.command(TrustPosition())
    bench.driver.command(Reset())
    assert bench.until(lambda: len(bench.of(Restarted)) == 2 and bench.state() is MillState.IDLE, 10.0)
    assert bench.driver.status.position_trusted


class Dumb:
    """A port on which something else answers."""

    url, wire_bytes_per_s = "dumb://", None

    def __init__(self, answer: bytes) -> None:
        self.answer, self.now_s, self.asked = answer, 0.0, b""

    def read(self, timeout_s: float) -> bytes:
        self.now_s += max(timeout_s, 0.001)
        return self.answer

    def write(self, data: bytes) -> None:
        self.asked += data

    def wake(self) -> None: ...
    def close(self) -> None: ...
    def clock(self) -> float:
        return self.now_s


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (b"", "nothing answers"),
        (bytes([0xF8, 0x80, 0x78, 0xFE]), "baud rate"),
        (b"login: \r\n", "not a GRBL"),
        (b"T:20.0 /0.0\nok\n", "not a GRBL"),
    ],
)
def test_what_is_not_a_controller_is_named_and_only_asked(answer: bytes, words: str) -> None:
    port = Dumb(answer)
    driver = GrblDriver(port)
    driver.connect()
    events = []
    while not events or driver.status.state is not MillState.DISCONNECTED:
        events += driver.poll(0.2)
        assert port.now_s < 30.0
    assert set(port.asked) == {ord("?")}
    assert isinstance(driver.failure, NotAControllerError)
    assert words in str(driver.failure) and "dumb://" in str(driver.failure)
    assert any(isinstance(event, Faulted) and words in event.words for event in events)


def test_a_running_mill_is_found_running_and_can_be_aborted() -> None:
    """The host that streamed has died; a new one connects while the rest of the buffer is cut."""
    bench = Bench().connected()
    bench.start(numbered([b"G21G90G94", *(b"G1X%dF300" % (k % 2 * 20) for k in range(1, 9))]))
    bench.pass_time(3.0)
    second = GrblDriver(bench.tap)
    second.connect()
    events = []
    end_s = bench.mill.now_s + 3.0
    while second.status.state is not MillState.RUN and bench.mill.now_s < end_s:
        events += second.poll(0.1)
    assert second.status.state is MillState.RUN
    second.abort()
    while not any(isinstance(event, Stopped) for event in events):
        events += second.poll(0.1)
        assert bench.mill.now_s < end_s + 5.0


@pytest.mark.parametrize(("mark", "place"), [(b"[GC:", k) for k in range(3, 40)] + [(b"$131=", k) for k in range(12)])
def test_what_was_damaged_on_the_way_is_asked_for_again(mark: bytes, place: int) -> None:
    """A byte lost from [GC:...] makes G54 a G4, from $131=300.000 no travel at all: never believed."""

    class Losing(Tap):
        lost = False

        def read(self, timeout_s: float) -> bytes:
            data = super().read(timeout_s)
            at = data.find(mark)
            if at >= 0 and not self.lost:
                self.lost = True
                data = data[: at + place] + data[at + place + 1 :]
            return data

    bench = Bench(link=Losing).connected()
    assert bench.tap.lost and bench.driver.settings.travel_mm == (300.0, 300.0, 80.0)
    assert bench.driver.settings.parser_state.split()[:6] == ["G0", "G54", "G17", "G21", "G90", "G94"]


@pytest.mark.parametrize(
    ("words", "right"),
    [
        ("G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0", True),
        ("G1 G59.1 G17 G20 G91 G94 G49 G98 G50 M5 M9 T0 F0 S0.", True),
        ("G0 G4 G17 G21 G90 G94 M5 M9 T0 F0 S0", False),
        ("G0G54 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0", False),
        ("G0 G54 G17 G21 G90 M5 M9", False),
        ("", False),
    ],
)
def test_a_parser_state_names_one_of_each_group(words: str, right: bool) -> None:
    assert is_parser_state(words) is right


WARM_UP_S = 300
PROGRAM = (
    b"G21G90G94G17G54|G0Z5|G0X-2Y-2|G1X10F1200|Y8|X-2|Y-2|M3S3000|G4P%d|M3S12000|G4P4|M8|G0X0Y0|Z1|G1Z-0.5F600|X8|Y6|"
    b"G0Z5|M9|M5|M2" % WARM_UP_S
).split(b"|")


@pytest.mark.parametrize("traits", [GRBL_11, GRBL_11_ECHO, GRBLHAL, FLUIDNC], ids=["1.1", "echo", "hal", "fluidnc"])
def test_a_long_warm_up_is_no_fault_and_coolant_runs_while_it_cuts(traits: Traits) -> None:
    """Five minutes without an answer are the program's own; where the mill cuts, spindle and coolant are on."""
    bench = Bench(traits).connected()
    bench.start(numbered(PROGRAM))
    firmware, deep = bench.mill.firmware, []
    while not (bench.of(ProgramDone) or bench.of(Faulted)):
        assert bench.mill.now_s < 2 * WARM_UP_S
        bench.events += bench.driver.poll(0.2)
        if (at := bench.driver.status.work_mm) is not None and at[2] < -0.4:
            deep.append((firmware.spindle, set(firmware.interpreter.coolant)))
    assert not bench.of(Faulted), bench.of(Faulted)
    assert deep[:-1] and all(state == ("M3", {"M8"}) for state in deep[1:-1])
    assert firmware.spindle == "M5" and firmware.interpreter.coolant == set()
    assert bench.mill.now_s > WARM_UP_S


@pytest.mark.parametrize("traits", [GRBL_11, GRBLHAL], ids=["1.1", "hal"])
def test_the_end_of_a_program_switches_coolant_off_even_if_it_does_not_say_so(traits: Traits) -> None:
    bench = Bench(traits).connected()
    bench.run(numbered([line for line in PROGRAM if line not in (b"M9", b"G4P%d" % WARM_UP_S)]), 120.0)
    assert bench.of(ProgramDone) and bench.mill.firmware.interpreter.coolant == set()
