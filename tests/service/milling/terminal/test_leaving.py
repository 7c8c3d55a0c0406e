"""However `stream` ends: the controller holds nothing that a cycle start could cut, or the person is told so loudly."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from machines.driver import MillState, MillStatus
from machines.mill.view import MillSnapshot
from machines.runs import RunReport, RunState
from service.milling.terminal.follow import Ended, RunFollower
from service.milling.terminal.leaving import STILL_HELD, Buffers
from tests.service.mills import WITH_SWITCHES, Bench, bench, program
from tests.service.terminal import ROOT, Terminal
from tests.waiting import PATIENCE_S, until

LONG = 2000
LOUD = "CONTROLLER MAY STILL HOLD LINES"


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))


class Watched:
    """The mill's thread as `Follower` uses it, with the snapshot of the moment."""

    def __init__(self) -> None:
        self.snapshot = MillSnapshot(status=MillStatus(state=MillState.RUN, epoch=1))

    def call(self, _: object) -> None: ...

    def shows(self, state: MillState, run: RunState, epoch: int) -> MillSnapshot:
        view = RunReport(id="r", name="p", program="", path="", state=run)
        self.snapshot = MillSnapshot(status=MillStatus(state=state, epoch=epoch), run=view)
        return self.snapshot


def follow_watched() -> tuple[Any, RunFollower]:
    """A thread whose snapshots a test says, and the follower of its run of ten lines."""
    thread: Any = Watched()
    buffers = Buffers(thread)
    buffers.fill("r")
    facts: Any = SimpleNamespace(lines=10)
    screen: Any = None
    return thread, RunFollower(thread, buffers, "r", facts, screen, keyboard=None)


@pytest.mark.parametrize("over", [RunState.INTERRUPTED, RunState.ABORTED])
def test_a_run_that_is_over_is_followed_until_the_banner_after_its_reset(over: RunState) -> None:
    """A mill that stands in Hold holds its queue still."""
    thread, follower = follow_watched()
    for state in (MillState.HOLDING, MillState.HELD, MillState.ALARM):
        assert follower._find_end(thread.shows(state, over, epoch=1)) is None
    ended = follower._find_end(thread.shows(MillState.CONNECTING, over, epoch=2))
    assert ended is (Ended.FAULT if over is RunState.INTERRUPTED else Ended.ABORTED)
    assert follower._make_outcome(ended).cleared


def test_a_link_that_came_back_proves_nothing() -> None:
    """A new link counts banners from 0, and the mill goes on alone: no end without the words."""
    thread, follower = follow_watched()
    for state in (MillState.DISCONNECTED, MillState.RUN, MillState.IDLE):
        assert follower._find_end(thread.shows(state, RunState.INTERRUPTED, epoch=0)) is Ended.FAULT
        assert not follower._make_outcome(Ended.FAULT).cleared


def test_a_run_of_before_that_finished_says_nothing_of_this_one() -> None:
    thread: Any = Watched()
    buffers = Buffers(thread)
    buffers.fill()
    finished = thread.shows(MillState.HOMING, RunState.FINISHED, epoch=1)
    assert not buffers.are_empty(finished)
    assert buffers.are_empty(dataclasses.replace(finished, status=MillStatus(epoch=2)))


def press_ctrl_c_twice(person: Terminal, _: Bench) -> None:
    person.ctrl_c()
    person.sees("Ctrl-C again")
    person.ctrl_c()


def leave_held(person: Terminal, _: Bench) -> None:
    person.types("q")
    person.sees("HELD")
    person.types("l")


ENDS: dict[str, tuple[Callable[[Terminal, Bench], None], bool]] = {  # whether the controller can be cleared
    "ctrl-c twice": (press_ctrl_c_twice, True),
    "abort": (lambda person, _: person.types("ay"), True),
    "left held": (leave_held, False),
    "fault": (lambda _, mill: mill.mill.firmware.say("error:20"), True),
    "SIGTERM": (lambda person, _: person.signals(signal.SIGTERM), True),
    "SIGHUP": (lambda person, _: person.signals(signal.SIGHUP), True),
    "lost port": (lambda _, mill: mill.unplug(), False),
}


@pytest.mark.parametrize("way", ENDS)
def test_no_end_leaves_lines_in_the_controller_without_a_word(tmp_path: Path, way: str) -> None:
    end, clears = ENDS[way]
    path = program(tmp_path / "p.nc", LONG)
    with bench(4.0) as mill, Terminal("stream", str(path), "--port", mill.url, "--yes") as person:
        person.sees("RUN")
        until(lambda: len(mill.cut) > 3)
        end(person, mill)
        assert person.ends() != 0
        said = " ".join(person.text.split())
        assert (LOUD in said) is not clears, said[-800:]
        if clears:
            assert mill.holds_nothing
        else:
            assert all(words in said for words in ("do not press cycle start", "Press the mill's own reset")), said


BREAKS = {
    "the display": "import service.milling.terminal.follow as module; name = 'RunFollower'; what = '_make_view'",
    "the mill's thread": "import machines.mill.mill as module; name = 'Mill'; what = 'step'",
}


@pytest.mark.parametrize("where", BREAKS)
def test_an_error_of_our_own_leaves_no_line_in_the_controller_or_says_so(tmp_path: Path, where: str) -> None:
    """The display breaks: the mill is stopped and cleared. Its own thread breaks: nobody is left to do it."""
    path = program(tmp_path / "p.nc", LONG)
    flag = tmp_path / "break"
    script = (
        f"{BREAKS[where]}; import os, sys; kind = getattr(module, name); real = getattr(kind, what)\n"
        "def broken(self, *arguments):\n"
        f"    if os.path.exists({str(flag)!r}): raise RuntimeError('broken on purpose')\n"
        "    return real(self, *arguments)\n"
        "setattr(kind, what, broken)\n"
        "from service.cli.main import run; sys.exit(run(sys.argv[1:]))"
    )
    with bench(4.0) as mill:
        process = subprocess.Popen(
            [sys.executable, "-c", script, "stream", str(path), "--port", mill.url, "--yes"],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        until(lambda: len(mill.cut) > 3)
        flag.touch()
        _, errors = process.communicate(timeout=PATIENCE_S)
        assert process.returncode != 0
        assert mill.holds_nothing or STILL_HELD in errors, errors[-800:]
        if where == "the display":
            assert mill.holds_nothing
            assert LOUD not in errors
            assert "the mill is left in state" in errors
            assert f"to go on: causticmill stream {path}" in errors
            assert not any(segment.kind == "slip" for segment in mill.mill.recording.segments)


def test_homing_that_the_person_breaks_off_is_stopped(tmp_path: Path) -> None:
    """Ctrl-C while the mill homes: it is not left moving with nobody there."""
    path = program(tmp_path / "p.nc", 5)
    slow = WITH_SWITCHES.with_settings({25: 100})
    with bench(1.0, traits=dataclasses.replace(slow, power_up_machine_mm=(-200.0, -200.0, -60.0))) as mill:
        with Terminal("stream", str(path), "--port", mill.url) as person:
            person.sees("u unlock")
            person.sees("> ")
            person.types("h\n")
            until(lambda: mill.mill.firmware.state == "Home")
            person.ctrl_c()
            assert person.ends() != 0
        assert mill.mill.firmware.state == "Alarm"
        assert mill.holds_nothing
