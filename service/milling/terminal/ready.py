"""Prepares a mill for a program: shows what must be done first, asks the person, carries it out and waits for its end.
Also prepares the recovery of an interrupted run and shows its plan in words and blocks. Nothing here moves the mill
except a homing cycle that the person asks for, and nothing is reset unless the person, or --confirm-position, says so.

`stream --dry-run`: the controller itself reads the whole program in check mode ($C); nothing moves. It needs no
journal, so it works on the driver alone, in this thread.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from machines.clock import Timeout
from machines.driver import (
    CheckMode,
    Command,
    CommandDone,
    Driver,
    Event,
    Faulted,
    Home,
    MillState,
    MillStatus,
    ProgramDone,
    ProgramLine,
    Reset,
    SendBlock,
    TrustPosition,
    Unlock,
    allow_always,
)
from machines.errors import MachineError, NotAControllerError, NotAllowedError
from machines.grbl.link import SILENT
from machines.mill.commands import command_words
from machines.mill.thread import MillThread
from machines.preflight.preflight import Preflight
from machines.recovery.needs import needs_of_standing_mill
from machines.recovery.plan_model import Need, RecoveryPlan
from machines.runs import RECOVERABLE, RunReport
from service.errors import FailedError, InputError
from service.milling.terminal.confirm import give_order
from service.milling.terminal.leaving import STILL_HELD, Buffers
from service.milling.terminal.screen import describe_mill_left, place_lines, print_lines

CONNECT_S = 90.0  # the driver gives up a silent link sooner, and says why
_MODE_S = 60.0  # the driver ends an unanswered command sooner
_POLL_S = 0.2
_STATUS_S = 1.0  # several status reports


def run_check_mode(
    driver: Driver, url: str, lines: Iterator[ProgramLine], on_line: Callable[[int], None]
) -> tuple[str, ...]:
    """Send all lines in check mode; return the protections that were active. FailedError names the refused line."""
    driver.connect()
    _poll_until(
        driver, url, CONNECT_S, lambda _: driver.status.state not in (MillState.CONNECTING, MillState.DISCONNECTED)
    )
    if driver.status.state is not MillState.IDLE:
        raise FailedError(f"dry run: the mill is {driver.status.state.value}; allowed when it is idle")
    try:
        _set_check_mode(driver, url, on=True)
        protections = driver.protections
        driver.start(lines, allow_always)
        while True:
            for event in driver.poll(_POLL_S):
                if isinstance(event, Faulted):
                    raise FailedError(f"dry run: {event.cause.value}: {event.words}; nothing was moved")
                if isinstance(event, ProgramDone):
                    return protections
            on_line(driver.progress.answered_line)
    finally:
        _leave(driver, url)


def _set_check_mode(driver: Driver, url: str, *, on: bool) -> None:
    """Switch check mode on or off and wait for the confirmation."""
    command = CheckMode(on)
    failures: list[str] = []
    driver.command(command, allow_always)

    def is_done(events: tuple[Event, ...]) -> bool:
        mine = [event for event in events if isinstance(event, CommandDone) and event.command == command]
        failures.extend(event.failure for event in mine if event.failure)
        return bool(mine)

    _poll_until(driver, url, _MODE_S, is_done)
    if failures:
        raise FailedError(f"dry run: {failures[0]}")


def _leave(driver: Driver, url: str) -> None:
    """Leave check mode in any state of the stream; warn if the controller cannot be reached."""
    try:
        if driver.progress.streaming:
            driver.abort()
            _poll_until(driver, url, _MODE_S, lambda _: not driver.progress.streaming)
        late = Timeout(_STATUS_S)  # an interrupt may have come before the status that answers $C
        _poll_until(driver, url, _MODE_S, lambda _: driver.status.state is MillState.CHECK or late.is_over)
        if driver.status.state is MillState.CHECK:
            _set_check_mode(driver, url, on=False)
    except MachineError as error:
        print(f"check mode could not be left: {error}; reset the controller")


def _poll_until(driver: Driver, url: str, wait_s: float, is_done: Callable[[tuple[Event, ...]], bool]) -> None:
    timeout = Timeout(wait_s)
    while True:
        events = driver.poll(_POLL_S)
        for event in events:
            if isinstance(event, Faulted):
                raise NotAControllerError(url, event.words.removeprefix(f"port {url}: "))
        if is_done(events):
            return
        if timeout.is_over:
            raise make_unconnected_error(url, driver.status)


def make_unconnected_error(url: str, status: MillStatus) -> NotAControllerError:
    """Return the error for a link that is neither ready nor given up by now; it says what the link waits for."""
    detail = f" ({status.detail})" if status.detail else ""
    return NotAControllerError(url, f"the mill is still {status.state.value}{detail}; given up")


_SOON_S = 10.0
_RUN_OUT_S = 120.0
_HOMING_S = 300.0
_FRAME_S = 1800.0  # once around a large lens at this feed, with a margin
FRAME_MM_PER_MIN = 1000.0
_ANSWER_S = 60.0  # the driver ends an unanswered command sooner: it knows the delay of its answers
_TAKEN_S = 4.0  # the driver may still be busy with the reset after an alarm
_LINK_S = 12.0  # a link on which nothing answers is given up and opened again meanwhile
_LOOK_S = 0.1

Remedy = tuple[str, str, Command]  # the key, what it does, how

_HOME: Remedy = ("h", "home: the mill MOVES to its switches, and knows its position again", Home())
_REMEDIES: dict[str, tuple[Remedy, ...]] = {
    "unlock": (_HOME, ("u", "unlock: nothing moves, and the position is taken as it is", Unlock())),
    "position": (_HOME, ("t", "trust: you know that the position is right, you have measured it", TrustPosition())),
    "stand still": (("x", "reset: nothing moves, what the controller still holds is forgotten", Reset()),),
}
_BY_OPTION: dict[str, Command] = {"unlock": Unlock(), "position": TrustPosition(), "stand still": Reset()}


def prepare_mill(thread: MillThread, buffers: Buffers, *, person: bool) -> None:
    """Make the mill ready for a new program. FailedError or InputError says why it is not ready."""
    did = meet_needs(thread, buffers, lambda: tuple(needs_of_standing_mill(thread.snapshot.status)), person=person)
    if did:
        print_lines(place_lines(thread.snapshot.status))


def reset_silent_mill(thread: MillThread, buffers: Buffers) -> None:
    """Offer a reset if nothing answers; InputError if the person declines."""
    print_lines([f"first:      {SILENT}"])
    print("            x reset: it stops whatever the controller does; a mill that moves loses its position")
    print("            anything else: stop here > ", end="", flush=True)
    if sys.stdin.readline().strip().lower() != "x":
        raise InputError("stopped here; nothing was sent but questions")
    buffers.fill()
    _give(thread, Reset(), _LINK_S)
    timeout = Timeout(_SOON_S)
    while not buffers.are_empty() and not thread.snapshot.problem and not timeout.is_over:
        thread.wait_for_change(thread.snapshot.version, _LOOK_S)
    buffers.mark_empty()  # this process has sent no program lines


def meet_needs(
    thread: MillThread,
    buffers: Buffers,
    needs: Callable[[], Iterable[Need]],
    *,
    zero_back: Callable[[], str] = str,
    person: bool,
    vouched: bool = False,
) -> bool:
    """Meet one need after the other until none is left; return whether anything was done.

    zero_back : the block that restores the work zero at which the program was cut; "" if that is not known
    person    : somebody is at the terminal, is asked, and may try again what has failed
    vouched   : --confirm-position was given; without a person nothing is done twice
    """
    done: set[str] = set()
    while (need := next(iter(needs()), None)) is not None:
        if need.code in ("connect", "wait"):
            _wait_for(thread, buffers, need)
            continue
        remedies = _remedies(thread, need, zero_back())
        if not remedies or not (person or (vouched and need.code in _BY_OPTION and need.code not in done)):
            asked = "" if person or not remedies else "; on a terminal this command offers that itself"
            raise FailedError(f"first: {need.words}{asked}")
        print_lines([f"first:      {need.words}"])
        by_option = _BY_OPTION.get(need.code) if vouched and need.code not in done else None
        command = by_option or _ask(thread, need, remedies)
        done.add(need.code)
        print_lines([f"mill:       {carry_out(thread, buffers, command)}"])
        _await_report(thread, need)
    return bool(done)


def _remedies(thread: MillThread, need: Need, zero_back: str) -> list[Remedy]:
    """Return the commands that a person may choose from; empty if the need must be met by hand at the mill."""
    if need.code == "zero" and zero_back:
        words = f"put the zero back where this program was cut: {zero_back}; nothing moves"
        return [("b", words, SendBlock(zero_back))]
    settings = thread.snapshot.settings
    switches = settings is None or settings.homing is not False
    return [one for one in _REMEDIES.get(need.code, ()) if switches or one is not _HOME]


def _ask(thread: MillThread, need: Need, offered: list[Remedy]) -> Command:
    """Ask the person which command meets the need; never guess."""
    for key, words, _ in offered:
        print(f"            {key} {words}")
    print("            anything else: stop here > ", end="", flush=True)
    answer = sys.stdin.readline().strip().lower()
    for key, _, command in offered:
        if answer == key:
            return command
    raise InputError(f"stopped here ({need.code}); nothing was started", describe_mill_left(thread.snapshot.status))


def carry_out(thread: MillThread, buffers: Buffers, command: Command) -> str:
    """Give one command and wait until it has ended; return its outcome in words.

    Only its own end counts: the command itself changes the mill's state meanwhile, so no state is reacted to.
    """
    if isinstance(command, Reset):
        return _reset(thread, buffers)
    moves = isinstance(command, Home)
    name = command_words(CommandDone(command), from_mm=None, at_mm=None).partition(":")[0]
    before = _last_number(thread)
    if moves:
        buffers.fill()
    try:
        _give(thread, command, _TAKEN_S)
    except MachineError as error:
        buffers.mark_empty()
        return str(error)
    return _await_end(thread, buffers, name, before, _HOMING_S if moves else _ANSWER_S)


def frame_job(thread: MillThread, buffers: Buffers, run: RunReport) -> None:
    """Go around the outline of a parked program, as a person has confirmed. FailedError if the way was not finished.

    Ctrl-C meanwhile stops the mill.
    """
    print_lines(["frame:      around the outline at the safe height; Ctrl-C stops the mill"])
    before = _last_number(thread)
    buffers.fill()
    try:
        give_order(thread, "frame", lambda mill: mill.frame(run.program, FRAME_MM_PER_MIN, confirmed=True))
    except MachineError:
        buffers.mark_empty()
        raise
    words = _await_end(thread, buffers, f"Frame of {run.name}", before, _FRAME_S)
    print_lines([f"mill:       {words}"])
    if not words.endswith(": done"):
        raise FailedError("the way around the outline was not finished; nothing was started")


def _last_number(thread: MillThread) -> int:
    events = thread.snapshot.events
    return events[-1].number if events else 0


def _await_end(thread: MillThread, buffers: Buffers, name: str, before: int, wait_s: float) -> str:
    """Wait until the command with this name, given after this entry of the log, has ended; return its outcome."""
    timeout = Timeout(wait_s)
    while not timeout.is_over:
        snapshot = thread.snapshot
        for entry in snapshot.events:
            if entry.number > before and entry.kind == "command" and entry.words.startswith(name):
                _settle(thread)
                buffers.mark_empty()
                return entry.words
        thread.wait_for_change(snapshot.version, _LOOK_S)
    raise FailedError(f"{name}: no answer from the mill; go and look at it")


def _give(thread: MillThread, command: Command, timeout_s: float) -> None:
    """Give a command; NotAllowedError if the mill does not accept it within a moment."""
    timeout = Timeout(timeout_s)
    while True:
        try:
            give_order(thread, type(command).__name__.lower(), lambda mill: mill.command(command))
            return
        except NotAllowedError:
            if timeout.is_over:
                raise
            thread.wait_for_change(thread.snapshot.version, _LOOK_S)


def _reset(thread: MillThread, buffers: Buffers) -> str:
    buffers.fill()
    if not buffers.clear():
        raise FailedError("the mill does not confirm the reset", STILL_HELD)
    _settle(thread)
    return "Reset: done, the controller holds nothing any more"


def _settle(thread: MillThread) -> None:
    """Wait until the driver has identified the controller again after a reset or an alarm."""
    timeout = Timeout(_ANSWER_S)
    thread.call(lambda _: None)
    while not (snapshot := thread.snapshot).connected and not timeout.is_over:
        thread.wait_for_change(snapshot.version, _LOOK_S)


def _await_report(thread: MillThread, need: Need) -> None:
    """Wait for a report newer than the command."""
    timeout = Timeout(_TAKEN_S)
    while any(one.code == need.code for one in needs_of_standing_mill(thread.snapshot.status)) and not timeout.is_over:
        thread.wait_for_change(thread.snapshot.version, _LOOK_S)


def _wait_for(thread: MillThread, buffers: Buffers, need: Need) -> None:
    """Wait for a link, or until a mill has carried out its buffer. Ctrl-C meanwhile stops the mill."""
    wait_s = _ANSWER_S
    if need.code == "wait":
        wait_s = _RUN_OUT_S
        print_lines([f"first:      {need.words}", "            waiting for it now; Ctrl-C stops the mill"])
        buffers.fill()
    timeout = Timeout(wait_s)
    thread.wait_for_change(thread.snapshot.version, _LOOK_S)
    while any(one.code == need.code for one in needs_of_standing_mill(thread.snapshot.status)):
        if timeout.is_over:
            raise FailedError(f"first: {need.words}; given up after {wait_s:.0f} s")
        thread.wait_for_change(thread.snapshot.version, _LOOK_S)
    buffers.mark_empty()


def find_interrupted_run(thread: MillThread, facts: Preflight, program: Path) -> RunReport:
    """Find the latest incomplete run of this same program."""
    runs = [run for run in thread.snapshot.runs if run.program == facts.sha256 and run.state in RECOVERABLE]
    if not runs:
        raise InputError(
            f"no interrupted run of {program.name}, as it is now, is known for this mill; start it without --recover"
        )
    return max(runs, key=lambda run: run.created_s)


def prepare_plan(thread: MillThread, buffers: Buffers, run: RunReport, *, person: bool, vouched: bool) -> RecoveryPlan:
    """Return the plan once all its preconditions are met; FailedError names one that is not.

    person : somebody is at the terminal and can be asked     vouched : --confirm-position was given
    """
    plan: RecoveryPlan

    def needs() -> tuple[Need, ...]:
        nonlocal plan
        plan = thread.call(lambda mill: mill.plan_recovery(run.id))
        if plan.refusals:
            raise FailedError(*(f"this run cannot go on: {words}" for words in plan.refusals))
        return plan.needs

    meet_needs(thread, buffers, needs, zero_back=lambda: plan.zero_back, person=person, vouched=vouched)
    print_lines(plan_lines(plan, run))
    return plan


def plan_lines(plan: RecoveryPlan, run: RunReport) -> Iterator[str]:
    """Yield the plan for a person to check."""
    yield f"recovery:   run {run.id}, {run.state.value}{f': {run.words}' if run.words else ''}"
    for words in plan.words:
        yield f"            {words}"
    for words in plan.differences:
        yield f"offset:     {words}"
    for number, block in enumerate(plan.blocks):
        yield f"{'way in:' if number == 0 else '':<11} {block}"
    yield f"{'then:':<11} line {plan.overlap_line:,} and on; {plan.recut_lines} of them for the second time"
