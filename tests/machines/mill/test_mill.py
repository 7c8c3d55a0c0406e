"""The mill's owner against the simulated mill, in simulated time: who may do what, and what a fault leaves behind."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from machines.driver import (
    Command,
    Home,
    Jog,
    MillState,
    ProbeZ,
    Reset,
    SendBlock,
    SetZero,
    TrustPosition,
    Unlock,
)
from machines.errors import JournalError, NotAllowedError, ProgramChangedError
from machines.journal.journal import Journal, read_journal
from machines.preflight.preflight import AT_PRESENT_ZERO, Finding
from machines.runs import START_CHECKS, Confirmation, RunState
from machines.simulated import reports
from phrases.phrase import Phrase
from tests.machines.disks import ROOM, InlineSyncer
from tests.machines.shop import LINES, YES, YES_ALL, Shop
from tests.trials.kill_trial import one_kill


def test_a_run_to_its_end(shop: Shop) -> None:
    assert shop.state is RunState.PARKED
    shop.pass_s(5.0)
    assert shop.cuts == 0
    shop.started().until(RunState.FINISHED)
    view = shop.mill.snapshot.run
    assert view.executed_line == len(LINES) and view.share == 1.0 and view.operator == "ann"
    content = read_journal(shop.bench.folder / "runs" / shop.id)
    assert content is not None and content.state["state"] == "finished" and content.state["offsets"]["G54"] == [0, 0, 0]
    assert content.state["checks"] == sorted(START_CHECKS) and "values" in content.state["settings"]


def test_what_is_said_of_the_work_zero_is_forgotten_when_it_is_set_again(shop: Shop) -> None:
    lasting, passing = Phrase("the feed is high"), Phrase(f"{AT_PRESENT_ZERO} X would go from -3 to 23 mm")
    second = shop.mill.park(
        replace(shop.facts, findings=(Finding("feed", False, lasting), Finding("placement", False, passing))),
        shop.path,
        "part 2",
    ).id

    def warnings() -> tuple[str, ...]:
        return next(one.warnings for one in shop.mill.snapshot.runs if one.id == second)

    assert warnings() == (lasting, passing)
    shop.bench.command_done(SetZero("XYZ"))
    assert warnings() == (lasting,)


@pytest.mark.parametrize("missing", sorted(START_CHECKS))
def test_a_start_needs_every_confirmation(shop: Shop, missing: str) -> None:
    with pytest.raises(NotAllowedError, match=missing):
        shop.mill.start(shop.id, Confirmation("ann", START_CHECKS - {missing}))
    shop.pass_s(2.0)
    assert shop.state is RunState.PARKED and shop.cuts == 0


def test_one_run_at_a_time_and_each_only_once(shop: Shop) -> None:
    other = shop.mill.park(shop.facts, shop.path, "second").id
    shop.started()
    with pytest.raises(NotAllowedError, match="one run at a time"):
        shop.mill.start(other, YES)
    with pytest.raises(NotAllowedError, match="running and does not wait for its start"):
        shop.mill.start(shop.id, YES)
    with pytest.raises(NotAllowedError, match="running"):
        shop.mill.plan_recovery(shop.id)


def test_a_program_of_another_size_is_not_started(shop: Shop) -> None:
    shop.path.write_text("M2\n")
    with pytest.raises(ProgramChangedError, match="pre-flight"):
        shop.mill.start(shop.id, YES)


def test_modes_a_program_takes_for_granted_are_demanded(shop: Shop) -> None:
    shop.bench.command_done(SendBlock("G55"))
    with pytest.raises(NotAllowedError, match="assumes G54"):
        shop.mill.start(shop.id, YES)
    shop.bench.command_done(SendBlock("G54"))
    shop.mill.start(shop.id, YES)


@pytest.mark.parametrize("end", [Unlock(), Home(), Reset()])
def test_a_program_never_begins_in_the_modes_of_a_probe_that_failed(shop: Shop, end: Command) -> None:
    """ALARM:5 leaves G91 G38.2: a line of axis words alone would probe, from where the tool stands."""
    shop.bench.command_done(SendBlock("$22=1"))
    shop.bench.command_done(ProbeZ(depth_mm=1.0, feed_mm_per_min=300.0))
    assert "G38.2" in parser_state(shop) and "G91" in parser_state(shop)
    if isinstance(end, Reset):
        epoch = shop.mill.status.epoch
        shop.mill.command(end)
        shop.bench.until(lambda: shop.mill.status.epoch > epoch)
        shop.bench.until_state(MillState.ALARM)
        shop.pass_s(2.0)
        end = Unlock()
    shop.bench.command_done(end)
    shop.bench.until_state(MillState.IDLE)
    assert {"G0", "G90", "G21"} <= set(parser_state(shop))
    shop.mill.start(shop.id, YES)


def test_a_start_in_the_modes_of_a_probe_is_refused(shop: Shop) -> None:
    """One that was typed, or of another program before us."""
    shop.bench.sim.firmware.interpreter.modal["motion"] = "G38.2"
    with pytest.raises(NotAllowedError, match="assumes G0"):
        shop.mill.start(shop.id, YES)
    shop.bench.command_done(SendBlock("G0"))
    shop.mill.start(shop.id, YES)


def parser_state(shop: Shop) -> list[str]:
    return reports.parser_state(shop.bench.sim.firmware).strip("[]").removeprefix("GC:").split()


def test_hold_and_resume(shop: Shop) -> None:
    shop.started()
    shop.mill.hold()
    assert shop.state is RunState.HOLDING
    shop.until(RunState.HELD)
    before = shop.cuts
    shop.pass_s(30.0)
    assert shop.cuts == before
    shop.mill.resume()
    shop.until(RunState.FINISHED)


def test_a_button_on_the_machine_holds_the_run_and_is_no_fault(shop: Shop) -> None:
    shop.started()
    shop.bench.sim.press("hold")
    shop.until(RunState.HELD)
    shop.pass_s(20.0)
    assert shop.state is RunState.HELD
    shop.bench.sim.press("start")
    shop.until(RunState.RUNNING)
    shop.until(RunState.FINISHED)


def test_m0_holds_the_run_until_a_person_resumes(tmp_path: Path) -> None:
    shop = Shop(tmp_path, [*LINES[:20], "M0", *LINES[20:]])
    shop.started()
    shop.until(RunState.HELD)
    assert "waits for a person" in shop.mill.snapshot.run.words
    shop.pass_s(60.0)
    assert shop.state is RunState.HELD
    shop.mill.resume()
    shop.until(RunState.FINISHED)
    shop.mill.close()


def test_abort_ends_in_aborted_and_the_part_is_not_lost(shop: Shop) -> None:
    shop.started().aborted()
    assert shop.mill.status.position_trusted
    plan = shop.mill.plan_recovery(shop.id)
    assert plan.ready and plan.resume_line == shop.mill.run(shop.id).executed_line + 1
    shop.mill.recover(shop.id, YES_ALL)
    assert shop.state is RunState.RECOVERING
    shop.until(RunState.RUNNING)
    shop.until(RunState.FINISHED)


def test_a_recovery_that_is_stopped_on_its_way_in_forgets_nothing(shop: Shop) -> None:
    shop.started(20)
    for _ in range(2):
        shop.aborted()
        executed = shop.mill.run(shop.id).executed_line
        assert executed > 10
        shop.mill.recover(shop.id, YES_ALL)
        shop.pass_s(1.0)
        assert shop.state is RunState.RECOVERING and shop.mill.run(shop.id).executed_line == executed
    shop.until(RunState.FINISHED)


def test_recovery_needs_the_word_for_the_position(shop: Shop) -> None:
    shop.started().aborted()
    with pytest.raises(NotAllowedError, match="confirmation of: position"):
        shop.mill.recover(shop.id, YES)


def test_a_pulled_cable_interrupts_and_nothing_moves_by_itself_afterwards(shop: Shop) -> None:
    shop.started()
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    run = shop.mill.snapshot.run
    assert run.code == "port lost" and run.words == f"port lost: {run.values['detail']}"
    shop.pass_s(30.0)
    shop.bench.sim.replug()
    shop.bench.until_state(MillState.IDLE)
    before = shop.cuts
    shop.pass_s(60.0)
    assert shop.cuts == before and shop.state is RunState.INTERRUPTED
    plan = shop.mill.plan_recovery(shop.id)
    assert plan.ready, plan.needs
    assert any("has not lost its count" in words for words in plan.words) and any(
        "spindle is ON" in w for w in plan.words
    )
    shop.mill.recover(shop.id, YES_ALL)
    shop.until(RunState.FINISHED)


def test_a_power_cycle_demands_the_position(shop: Shop) -> None:
    shop.started()
    shop.bench.sim.power_cycle()
    shop.until(RunState.INTERRUPTED)
    shop.bench.until_state(MillState.IDLE)
    plan = shop.mill.plan_recovery(shop.id)
    assert [need.code for need in plan.needs] == ["position"]
    with pytest.raises(NotAllowedError, match="restarted"):
        shop.mill.recover(shop.id, YES_ALL)
    shop.bench.command_done(TrustPosition())
    assert shop.mill.plan_recovery(shop.id).ready


def test_where_a_run_ended_is_remembered_whatever_the_mill_does_then(shop: Shop) -> None:
    """The plan tells of it: it would be another one half a second after a person has read it."""
    epoch = shop.started().mill.status.epoch
    shop.bench.sim.press("reset")
    shop.until(RunState.INTERRUPTED)
    shop.bench.until(lambda: shop.mill.status.epoch > epoch)
    shop.bench.until_state(MillState.ALARM)
    ended = [words for words in shop.mill.plan_recovery(shop.id).words if "last position" in words]
    shop.bench.command_done(Unlock())
    shop.bench.until_state(MillState.IDLE)
    shop.bench.command_done(Jog((0.0, 0.0, 3.0), 900.0))
    shop.bench.until_state(MillState.IDLE)
    plan = shop.mill.plan_recovery(shop.id)
    shop.pass_s(2.0)
    assert shop.mill.plan_recovery(shop.id).digest == plan.digest
    assert ended and ended[0] in plan.words


def test_what_was_zeroed_and_homed_is_told_until_the_position_is_lost(shop: Shop) -> None:
    assert (shop.mill.snapshot.zeroed, shop.mill.snapshot.homed) == ("", False)
    shop.bench.command_done(SetZero("XY"))
    shop.bench.command_done(SetZero("Z"))
    assert (shop.mill.snapshot.zeroed, shop.mill.snapshot.homed) == ("XYZ", False)
    shop.bench.sim.power_cycle()
    shop.bench.until(lambda: shop.mill.snapshot.zeroed == "")
    assert shop.mill.snapshot.as_dict()["zeroed"] == ""


def test_a_zero_is_set_anew_until_a_program_starts(shop: Shop) -> None:
    """From then on it is the zero of that program's block."""
    shop.bench.command_done(SetZero("XY"))
    assert shop.mill.snapshot.as_dict()["zeroed_anew"] == "XY"
    shop.started()
    assert shop.mill.snapshot.zeroed == "XY"
    assert shop.mill.snapshot.zeroed_anew == ""


@pytest.mark.parametrize("order", ["hold", "abort"])
def test_what_is_asked_while_the_link_is_away_is_carried_out_first(tmp_path: Path, order: str) -> None:
    """The mill goes on with what it holds, long moves here; the hold reaches it when the cable is back."""
    lines = [*LINES[:5], *(f"G1 X{10 + 40 * (i % 2)} F600" for i in range(1, 40)), "G0 Z5", "M2"]
    shop = Shop(tmp_path, lines).started(2)
    shop.bench.sim.unplug()
    shop.until(RunState.INTERRUPTED)
    getattr(shop.mill, order)()
    assert shop.mill.snapshot.latched == order
    shop.pass_s(3.0)
    shop.bench.sim.replug()
    if order == "hold":
        shop.bench.until_state(MillState.HELD)
        assert shop.state is RunState.INTERRUPTED
        assert shop.needs[:1] == ["stand still"]
    else:
        shop.until(RunState.ABORTED)
    before = shop.cuts
    shop.pass_s(30.0)
    assert shop.cuts <= before + 1
    assert shop.mill.snapshot.latched == ""
    shop.mill.close()


def test_a_full_disk_holds_the_mill_and_resume_tries_again(shop: Shop) -> None:
    shop.started()
    shop.disk.room = 0
    shop.bench.until_state(MillState.HELD)
    assert "no space left" in shop.mill.snapshot.run.words
    before = shop.cuts
    with pytest.raises(JournalError, match="no space left"):
        shop.mill.resume()
    shop.pass_s(20.0)
    assert shop.cuts == before
    shop.disk.room = ROOM
    shop.mill.resume()
    shop.until(RunState.FINISHED)


def test_nothing_starts_without_a_journal(shop: Shop) -> None:
    shop.disk.room = 0
    with pytest.raises(JournalError):
        shop.mill.start(shop.id, YES)
    shop.disk.room = ROOM
    shop.pass_s(5.0)
    assert shop.cuts == 0 and shop.state is RunState.PARKED
    shop.mill.start(shop.id, YES)
    shop.until(RunState.FINISHED)


def test_two_owners_of_one_folder(shop: Shop) -> None:
    with pytest.raises(NotAllowedError, match=r"another agent or stream \(process [0-9]+\) owns this mill"):
        shop.bench.new_mill()


def test_what_is_not_allowed_says_state_and_way_out(shop: Shop) -> None:
    with pytest.raises(NotAllowedError, match="no such run"):
        shop.mill.start("nothing", YES)
    shop.started()
    with pytest.raises(NotAllowedError, match="running"):
        shop.mill.resume()
    with pytest.raises(NotAllowedError, match="hold it"):
        shop.mill.close()


def test_snapshot_is_plain_data_and_versions_count_up(shop: Shop) -> None:
    first = shop.mill.snapshot
    shop.pass_s(1.0)
    again = shop.mill.snapshot
    assert json.loads(json.dumps(again.as_dict()))["name"] == "sim"
    shop.started()
    assert shop.mill.snapshot.version > again.version >= first.version


def test_an_idle_mill_makes_no_new_snapshots(shop: Shop) -> None:
    shop.pass_s(5.0)
    version = shop.mill.snapshot.version
    shop.pass_s(20.0)
    assert shop.mill.snapshot.version == version


def test_time_left_follows_how_the_run_goes(shop: Shop) -> None:
    """The estimate here is 60 s for what takes about 90: half way the rest is nearer the truth than the estimate."""
    shop.started()
    began_s = shop.bench.sim.now_s
    shop.bench.until(lambda: shop.mill.run(shop.id).share > 0.6)
    left_s, middle_s = shop.mill.run(shop.id).time_left_s, shop.bench.sim.now_s
    shop.until(RunState.FINISHED)
    really_s = shop.bench.sim.now_s - middle_s
    if middle_s - began_s > 25.0:
        assert left_s == pytest.approx(really_s, rel=0.4)


def test_journal_marks_come_at_least_every_second(tmp_path: Path) -> None:
    shop = Shop(tmp_path, LINES)
    seen: list[float] = []
    write = Journal.append

    def noted(self: Journal, kind: str, **fields: Any) -> None:
        seen.append(shop.bench.sim.now_s)
        write(self, kind, **fields)

    Journal.append = noted  # type: ignore[method-assign]
    try:
        shop.started().until(RunState.FINISHED)
    finally:
        Journal.append = write  # type: ignore[method-assign]
    gaps = [b - a for a, b in itertools.pairwise(seen)]
    assert max(gaps) <= 1.0
    assert InlineSyncer(lambda: 0.0).failure == ""
    shop.mill.close()


@pytest.mark.parametrize("seed", range(30))
def test_every_segment_is_cut_in_order_after_kills_and_power_losses(seed: int, tmp_path: Path) -> None:
    trial = one_kill(seed, tmp_path)
    assert trial.faults == []


def test_the_trials_kill_and_recut(tmp_path: Path) -> None:
    """Guards the test above: trials in which nothing dies would prove nothing."""
    trials = [one_kill(seed, tmp_path / str(seed), 60) for seed in range(6)]
    assert sum(trial.kills for trial in trials) >= 4
    assert any(trial.recut for trial in trials)
