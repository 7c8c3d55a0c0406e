"""Ways in which something could move unasked, or a stop could get lost; and what a bad disk or clock does."""

from __future__ import annotations

import dataclasses
import errno
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from machines.driver import Command, Home, Jog, MillState, SendBlock, SetZero
from machines.errors import JournalError, MachineError, NotAllowedError
from machines.journal.disk import RealFile
from machines.journal.journal import read_journal
from machines.mill.mill import Mill
from machines.mill.orders import Caller, OrderRefusedError, Refusal
from machines.mill.run_store import RunFolders
from machines.mill.thread import MillThread
from machines.preflight.preflight import Bounds, Preflight
from machines.recovery.plan_model import Reentry
from machines.runs import RunState
from tests.machines.disks import ROOM
from tests.machines.shop import LINES, YES, YES_ALL, Shop

LONG_MOVES = [*LINES[:5], *(f"G1 X{10 + 40 * (i % 2)} F600" for i in range(1, 40)), "G0 Z5", "M2"]


def unplugged(shop: Shop, seconds: float) -> None:
    """The mill goes on without us for a while; then the link is back."""
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    shop.pass_s(seconds)
    shop.bench.sim.replug()
    shop.bench.until_state(MillState.IDLE)


# ---------------------------------------------------------------------- a mill that went on alone


def test_what_the_mill_did_alone_is_booked_when_it_stands(shop: Shop) -> None:
    unplugged(shop.started(10), 30.0)
    known = shop.mill.run(shop.id).executed_line
    shop.pass_s(1.0)
    booked, sent = shop.mill.run(shop.id).executed_line, shop.mill.run(shop.id).sent_line
    assert known < booked <= sent and sent - booked <= 1
    content = read_journal(shop.bench.folder / "runs" / shop.id)
    assert content is not None and content.state["executed_line"] == booked and content.state["adrift"] == ""
    assert shop.mill.plan_recovery(shop.id).recut_lines <= 1


def test_it_is_booked_after_the_death_of_the_owner_as_well(shop: Shop) -> None:
    shop.started(10)
    known = shop.mill.run(shop.id).executed_line
    shop.replace_owner()
    shop.bench.sim.advance(shop.bench.sim.now_s + 30.0)
    shop.bench.until_state(MillState.IDLE)
    shop.pass_s(1.0)
    assert shop.mill.run(shop.id).executed_line > known
    assert shop.mill.plan_recovery(shop.id).ready


def test_a_plan_that_is_asked_for_at_once_waits_for_the_standstill(shop: Shop) -> None:
    unplugged(shop.started(10), 30.0)
    assert shop.mill.plan_recovery(shop.id).executed_line >= shop.mill.run(shop.id).sent_line - 1


@pytest.mark.parametrize("command", [Jog((0.5, 1.0, 0.0), 500.0), SetZero("XYZ"), SendBlock("G0 X30 Y11 Z-1")])
def test_after_the_mill_was_touched_its_place_proves_nothing(shop: Shop, command: Any) -> None:
    unplugged(shop.started(10), 30.0)
    known = shop.mill.run(shop.id).executed_line
    shop.mill.command(command)
    shop.pass_s(10.0)
    assert shop.mill.run(shop.id).executed_line == known
    shop.replace_owner(MillState.IDLE)
    shop.pass_s(2.0)
    assert shop.mill.run(shop.id).executed_line == known


def test_a_restart_while_out_of_sight_proves_nothing(shop: Shop) -> None:
    shop.started(10)
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    known = shop.mill.run(shop.id).executed_line
    shop.bench.sim.power_cycle()
    shop.bench.sim.replug()
    shop.bench.until_state(MillState.IDLE)
    shop.pass_s(3.0)
    assert shop.mill.run(shop.id).executed_line == known
    assert shop.needs == ["position"]


# ---------------------------------------------------------------------- stops


def test_abort_stops_a_jog_although_a_parked_run_waits(shop: Shop) -> None:
    """The parked run is taken back, and the mill is stopped as well."""
    shop.mill.command(Jog((100.0, 0.0, 0.0), 300.0))
    shop.bench.until_state(MillState.JOG)
    shop.mill.abort()
    assert shop.state is RunState.ABORTED
    shop.pass_s(2.0)
    before = shop.bench.sim.physical_mm
    shop.pass_s(10.0)
    assert shop.bench.sim.physical_mm == before and before[0] < 20.0


def test_an_abort_after_a_hold_takes_a_parked_run_back_and_leaves_the_mill_idle(shop: Shop) -> None:
    """At once: the mill has not yet said that it holds."""
    shop.mill.hold()
    shop.mill.abort()
    assert shop.state is RunState.ABORTED
    shop.pass_s(3.0)
    assert shop.mill.status.state is MillState.IDLE


def test_a_cycle_start_at_the_machine_does_not_go_on_without_a_journal(shop: Shop) -> None:
    shop.started()
    shop.disk.room = 0
    shop.bench.until_state(MillState.HELD)
    for _ in range(3):
        shop.bench.sim.press("start")
        shop.pass_s(3.0)
        assert shop.mill.status.state is MillState.HELD
    cuts = shop.cuts
    shop.pass_s(20.0)
    assert shop.cuts == cuts
    shop.disk.room = ROOM
    shop.mill.resume()
    shop.until(RunState.FINISHED)


@pytest.mark.parametrize("orders", [("hold", "abort"), ("abort", "hold")])
def test_of_two_latched_orders_the_abort_stays_and_resume_is_refused(tmp_path: Path, orders: tuple[str, str]) -> None:
    shop = Shop(tmp_path, LONG_MOVES).started(2)
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    for order in orders:
        getattr(shop.mill, order)()
    assert shop.mill.snapshot.latched == "abort"
    with pytest.raises(NotAllowedError, match="abort is carried out first"):
        shop.mill.resume()
    shop.bench.sim.replug()
    shop.until(RunState.ABORTED)
    shop.mill.close()


def test_an_abort_whose_end_was_not_seen_is_given_again_when_the_link_is_back(tmp_path: Path) -> None:
    shop = Shop(tmp_path, LONG_MOVES).started(2)
    shop.mill.abort()
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    assert shop.mill.snapshot.latched == "abort"
    shop.bench.sim.replug()
    shop.until(RunState.ABORTED)
    shop.mill.close()


def test_a_link_that_refuses_its_handshake_is_tried_again(shop: Shop) -> None:
    link, connect, tries = shop.mill._link, shop.mill._link._connect, []

    def refusing() -> Any:
        driver = connect()
        tries.append(driver)

        def refuse() -> None:
            raise MachineError("no handshake")

        if len(tries) < 3:
            driver.connect = refuse
        return driver

    link._connect = refusing
    shop.bench.sim.unplug()
    shop.pass_s(1.0)
    shop.bench.sim.replug()
    shop.bench.until_state(MillState.IDLE)
    assert len(tries) == 3


def test_a_call_that_was_given_up_never_begins(shop: Shop) -> None:
    """A start that nobody waits for any more must not come true a minute later."""
    thread, gate, begun = MillThread(shop.mill), threading.Event(), []
    thread.start()
    blocker = threading.Thread(target=lambda: thread.call(lambda mill: gate.wait(10.0)))
    blocker.start()
    time.sleep(0.05)
    with pytest.raises(MachineError, match="taken back"):
        thread.call(lambda mill: begun.append("moved"), timeout_s=0.1)
    gate.set()
    blocker.join()
    thread.call(lambda mill: None)
    assert begun == []
    thread.stop(detach=True)


def test_a_failing_owner_holds_a_run_that_pauses_between_two_lines(shop: Shop) -> None:
    shop.started()
    shop.mill.note_failure(RuntimeError("a bug"))
    shop.bench.sim.advance(shop.bench.sim.now_s + 3.0)
    before = shop.cuts
    shop.bench.sim.advance(shop.bench.sim.now_s + 10.0)
    assert shop.cuts == before


# ---------------------------------------------------------------------- disk and clock


def test_no_byte_of_a_program_leaves_before_its_start_is_safe_on_disk(
    shop: Shop, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: RealFile) -> None:
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(RealFile, "sync", refuse)
        with pytest.raises(JournalError, match="not safe on disk"):
            shop.mill.start(shop.id, YES)
    shop.pass_s(5.0)
    assert shop.cuts == 0 and shop.state is RunState.PARKED


@pytest.mark.parametrize("order", ["start", "resume"])
def test_a_stop_that_comes_while_an_order_waits_for_the_disk_is_the_last_word(shop: Shop, order: str) -> None:
    act = (lambda mill: mill.start(shop.id, YES)) if order == "start" else (lambda mill: mill.resume())
    if order == "resume":
        shop.started().held()
    before = shop.state, shop.cuts
    caller = Caller(grant=shop.mill.orders.issue_grant().word)
    shop.disk.before_write = shop.mill.orders.count_stop
    with pytest.raises(OrderRefusedError, match="stopped since"):
        shop.mill.carry_out(order, act, caller)
    shop.pass_s(3.0)
    assert (shop.state, shop.cuts) == before


def test_the_reminder_to_touch_off_outlives_the_agent(shop: Shop) -> None:
    shop.started().until(RunState.FINISHED)
    shop.replace_owner()
    assert "re-probe Z" in shop.mill.snapshot.needs[0]
    shop.bench.until_state(MillState.IDLE)
    shop.bench.command_done(SetZero("Z"))
    assert shop.mill.snapshot.needs == ()
    shop.replace_owner()
    assert shop.mill.snapshot.needs == ()


def test_a_clock_set_back_keeps_the_order_of_runs(shop: Shop) -> None:
    times = iter([1.9e9, 1.9e9, 1.7e9, 1.7e9, 1.8e9])
    made = []
    for wall_s in times:
        shop.mill._runs._wall = lambda wall_s=wall_s: wall_s
        made.append(shop.mill.park(shop.facts, shop.path, "part").id)
    assert made == sorted(made) and len(set(made)) == 5
    shop.replace_owner()
    assert [view.id for view in shop.mill.runs][::-1] == [shop.id, *made]


def test_an_interrupted_run_is_the_one_shown_after_the_death_of_its_owner(shop: Shop) -> None:
    shop.started()
    other = shop.mill.park(shop.facts, shop.path, "next").id
    shop.replace_owner()
    assert shop.mill.snapshot.run.id == shop.id and shop.state is RunState.INTERRUPTED
    assert shop.mill.run(other).state is RunState.PARKED


def test_old_finished_runs_leave_the_disk_but_no_interrupted_one(shop: Shop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("machines.mill.run_store.KEPT_RUNS", 3)
    unplugged(shop.started(), 5.0)
    shop.bench.until_state(MillState.IDLE)
    for _ in range(6):
        one = shop.mill.park(shop.facts, shop.path, "again").id
        shop.mill.abort()
    names = {path.name for path in RunFolders(shop.bench.folder).folder.iterdir()}
    assert shop.id in names and one in names and len(names) == 4
    assert {view.id for view in shop.mill.runs} == names
    shop.replace_owner()
    assert shop.state is RunState.INTERRUPTED


def test_a_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match="a writable folder"):
        Mill(name="m", connect=lambda: None, folder=tmp_path / "file" / "mill", reentry=Reentry(safe_z_mm=5.0))  # type: ignore[arg-type, return-value]


# ---------------------------------------------------------------------- place and frame


def test_what_was_zeroed_is_not_told_of_a_mill_that_was_out_of_sight(shop: Shop) -> None:
    shop.bench.command_done(SetZero("XY"))
    shop.bench.sim.unplug()
    shop.bench.until_state(MillState.DISCONNECTED)
    shop.bench.sim.replug()
    shop.bench.until_state(MillState.IDLE)
    assert shop.mill.snapshot.zeroed == ""


def homed(shop: Shop, soft_limits: bool, jog: tuple[float, float, float] = (-100.0, -100.0, -40.0)) -> None:
    """Homing on, work zero where the jog ends."""
    for block in ["$22=1", "$27=1", "$20=1"] if soft_limits else ["$22=1", "$27=1"]:
        shop.bench.command_done(SendBlock(block))
    shop.bench.command_done(Home())
    shop.bench.command_done(Jog(jog, 2000.0))
    shop.bench.command_done(SetZero("XYZ"))


@pytest.mark.parametrize("soft_limits", [True, False])
def test_a_program_that_leaves_the_travel_is_refused(shop: Shop, soft_limits: bool) -> None:
    """The program goes 50 mm in X from a zero 11 mm from the end of the travel."""
    shop.facts = framed(shop.facts)
    homed(shop, soft_limits, (-10.0, -100.0, -40.0))
    run_id = shop.mill.park(shop.facts, shop.path, "placed").id
    with pytest.raises(NotAllowedError, match=r"X would go .*from line [0-9]+ of") as refused:
        shop.mill.start(run_id, YES)
    assert "set the work zero elsewhere" in str(refused.value)
    assert (refused.value.code, refused.value.values["detail"].count("\n")) == ("travel", 0)
    shop.pass_s(2.0)
    assert shop.mill.run(run_id).state is RunState.PARKED and shop.cuts == 0


def test_without_homing_it_is_only_told(shop: Shop) -> None:
    shop.facts = framed(shop.facts)
    shop.bench.command_done(SendBlock("$22=1"))  # positions were never homed: Idle since before
    run_id = shop.mill.park(shop.facts, shop.path, "placed").id
    assert not shop.mill.status.position_trusted
    shop.mill.start(run_id, YES)
    assert any("X would go" in words for words in shop.mill.run(run_id).warnings)
    shop.mill.hold()


def test_a_program_that_would_begin_straight_down_beside_the_block_is_not_started(shop: Shop) -> None:
    shop.facts = framed(shop.facts)
    run_id = shop.mill.park(shop.facts, shop.path, "high").id
    shop.bench.command_done(Jog((-30.0, 0.0, 20.0), 2000.0))
    with pytest.raises(NotAllowedError, match=r"goes to Z5, and the tool stands at X-30.0 Y0.0 Z20.0"):
        shop.mill.start(run_id, YES)
    shop.bench.command_done(Jog((42.0, 10.2, 0.0), 2000.0))  # over the block that is in no one's way
    shop.mill.start(run_id, YES)
    shop.mill.hold()


def test_a_program_that_would_begin_on_a_slant_is_started_only_from_over_what_it_mills(tmp_path: Path) -> None:
    """Its first rapid ends a millimetre above the block: from beside it that may hit a clamp, from any height."""
    lines = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 X10 Y10 Z1", "G1 Z-1 F200", *LINES[5:]]
    shop = Shop(tmp_path, lines=lines)
    shop.facts = framed(shop.facts)
    run_id = shop.mill.park(shop.facts, shop.path, "slant").id
    for jog in ((0.0, 0.0, 0.0), (0.0, 0.0, 30.0)):
        if any(jog):
            shop.bench.command_done(Jog(jog, 2000.0))
        with pytest.raises(NotAllowedError, match="line 3 goes across at Z"):
            shop.mill.start(run_id, YES)
    shop.pass_s(2.0)
    assert shop.mill.run(run_id).state is RunState.PARKED and shop.cuts == 0
    shop.bench.command_done(Jog((10.0, 10.0, 0.0), 2000.0))
    shop.mill.start(run_id, YES)
    shop.mill.hold()
    shop.mill.close(detach=True)


def test_a_program_that_begins_in_machine_coordinates_asks_for_a_homed_mill(shop: Shop) -> None:
    machine = {"machine": Bounds((None, None, -1.0), (None, None, -1.0))}
    shop.facts = dataclasses.replace(shop.facts, bounds_by_frame=framed(shop.facts).bounds_by_frame | machine)
    run_id = shop.mill.park(shop.facts, shop.path, "raised").id
    with pytest.raises(NotAllowedError, match=r"G53.*this mill has no homing"):
        shop.mill.start(run_id, YES)
    shop.bench.command_done(SendBlock("$22=1"))
    with pytest.raises(NotAllowedError, match=r"G53.*home the mill"):
        shop.mill.start(run_id, YES)
    homed(shop, False)
    shop.mill.start(run_id, YES)
    shop.mill.hold()


def abort_a_run(shop: Shop, *, zero_z_mm: float) -> None:
    """A run that was begun within the travel of a homed mill, which stands."""
    shop.facts = framed(shop.facts)
    homed(shop, False, (-100.0, -100.0, zero_z_mm))
    shop.id = shop.mill.park(shop.facts, shop.path, "placed").id
    shop.started().aborted()


def test_a_way_back_in_goes_no_higher_than_the_mill_does(shop: Shop) -> None:
    """The program itself stays low enough; the height at which the tool should be brought back does not."""
    abort_a_run(shop, zero_z_mm=-6.0)
    assert shop.mill.plan_recovery(shop.id).ready
    shop.mill._planner.reentry = dataclasses.replace(shop.mill._planner.reentry, safe_z_mm=9.0)
    plan = shop.mill.plan_recovery(shop.id)
    assert plan.ready and "G0 Z7" in plan.blocks


def test_where_nobody_knows_how_high_the_mill_gets_a_way_back_in_beyond_that_is_told(shop: Shop) -> None:
    abort_a_run(shop, zero_z_mm=-6.0)
    shop.replace_owner(MillState.IDLE)
    shop.mill._planner.reentry = dataclasses.replace(shop.mill._planner.reentry, safe_z_mm=9.0)
    plan = shop.mill.plan_recovery(shop.id)
    assert plan.refusals == () and any("not certain: on the way back in Z would go" in words for words in plan.words)


def test_a_rest_that_leaves_the_travel_is_refused(shop: Shop) -> None:
    """The zero was set anew, by a person, 5 mm from the end of the travel."""
    abort_a_run(shop, zero_z_mm=-40.0)
    here_mm = shop.mill.status.machine_mm
    assert here_mm is not None
    shop.bench.command_done(Jog((-5.0 - here_mm[0], 0.0, 0.0), 2000.0))
    shop.bench.command_done(SetZero("XYZ"))
    plan = shop.mill.plan_recovery(shop.id)
    assert not plan.needs
    with pytest.raises(NotAllowedError, match=r"X would go .*from line [0-9]+ of .*home the mill"):
        shop.mill.recover(shop.id, YES_ALL)


def framed(facts: Preflight) -> Preflight:
    assert facts.bounds_mm is not None
    return dataclasses.replace(facts, bounds_by_frame={"G54": facts.bounds_mm})


@pytest.mark.parametrize("change", [SetZero("X"), SendBlock("G10 L20 P1 Y1")])
@pytest.mark.parametrize("order", ["start", "recover"])
def test_an_order_is_for_the_setup_or_the_plan_that_was_seen(shop: Shop, order: str, change: Command) -> None:
    """Somebody else has set a zero since the person looked."""
    if order == "recover":
        shop.started().aborted()
        seen = shop.mill.plan_recovery(shop.id).digest
    else:
        shop.bench.command_done(Jog((5.0, 0.0, 0.0), 600.0))
        seen = shop.mill.snapshot.setup
    shop.bench.command_done(change)
    shop.pass_s(1.0)
    before = shop.cuts
    with pytest.raises(OrderRefusedError) as refused:
        if order == "recover":
            shop.mill.recover(shop.id, YES_ALL, plan_seen=seen)
        else:
            shop.mill.start(shop.id, YES, setup=seen)
    assert refused.value.code == {"start": Refusal.SETUP, "recover": Refusal.PLAN}[order]
    shop.pass_s(3.0)
    assert shop.cuts == before


def test_a_refusal_names_the_program_and_never_an_id_that_the_caller_may_not_have(tmp_path: Path) -> None:
    """A job server has ids of its own for runs: those of their mill's owner reach nobody."""
    shop = Shop(tmp_path, LINES)
    other = shop.mill.park(shop.facts, shop.path, "other part").id
    refused = {
        "recovery of what was never started": lambda: shop.mill.plan_recovery(shop.id),
        "start of what runs": lambda: shop.mill.start(shop.id, YES),
        "start of another": lambda: shop.mill.start(other, YES),
        "resume of what runs": shop.mill.resume,
        "close": shop.mill.close,
        "no such run": lambda: shop.mill.start("20260101-000000-abcdef", YES),
    }
    for number, (what, act) in enumerate(refused.items()):
        if number == 1:
            shop.started()
        with pytest.raises(NotAllowedError) as error:
            act()
        assert not any(run in str(error.value) for run in (shop.id, other, "20260101")), what
        assert "part" in str(error.value) or what == "no such run", what
