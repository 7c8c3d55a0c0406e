"""`causticmill stream`: one program on one mill, from pre-flight to the last line, watched from this terminal.

Order: the link, which moves nothing; the program, read whole and held against the controller's own settings; what the
person should see; and nothing moves before that person, or the command itself where there is no terminal, has said so.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from machines.errors import NotAControllerError
from machines.gcode.preflight import Preflight
from machines.gcode.program import ProgramReader
from machines.grbl.settings import ControllerSettings
from machines.mill.mill import Mill
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot
from machines.profiles import MachineProfile
from machines.recovery.planning import Reentry
from machines.runs import RECOVER_CHECKS, START_CHECKS, Confirmation, RunView
from service.agent.settings import mill_folder, usable, usable_folder
from service.errors import EXIT_INTERRUPTED, FailedError, InputError, JobError, sentence_of_os_error
from service.mill_link import Connector, demand_blocks
from service.preflight import preflight
from service.progress import PlainReporter, Reporter, TerminalReporter
from service.stream.ask import RECOVER_QUESTIONS, START_QUESTIONS, confirmed_by_person, operator_name
from service.stream.dry import dry_run
from service.stream.follow import Ended, Follower, Outcome, at_once, keyboard
from service.stream.keys import single_keys
from service.stream.recover import interrupted_run, ready_plan
from service.stream.screen import LiveScreen, PlainScreen, Screen
from service.stream.signals import watched_signals
from service.stream.words import left_words, mill_lines, print_lines, program_lines, recover_command, took_words

_CONNECT_S = 15.0
_POSITION_S = 2.0
_SPINDLE_S = 4.5


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamOrder:
    """What the command line asks for. port_given is None where the profile's own port is meant."""

    program: Path
    profile: MachineProfile
    port_url: str
    port_given: str | None
    confirmed: bool = False
    recover: bool = False
    position_confirmed: bool = False
    dry_run: bool = False

    @property
    def next_command(self) -> str:
        return recover_command(self.program, self.port_given, self.profile.name)


class StoppedError(JobError):
    """The run was stopped by a signal or by the person."""

    exit_code = EXIT_INTERRUPTED


def stream_program(order: StreamOrder) -> None:
    """Run the program; returns when it is finished, raises a JobError in every other case."""
    _require_answers(order)
    if order.dry_run:
        _dry_run(order)
        return
    folder = usable_folder(mill_folder(order.profile.name, own_port=order.profile.link.port, port_url=order.port_url))
    with _mill(order, folder) as (thread, connector):
        snapshot = _connected(thread, order.port_url)
        facts = _preflight(order, connector.settings)
        print_lines(mill_lines(order.port_url, snapshot.status, snapshot.protections, snapshot.facts))
        print_lines(program_lines(order.program, facts))
        if order.recover:
            run_id, confirmation = _recovery(thread, order, facts)
        else:
            run_id, confirmation = _new_run(thread, order, facts)
        outcome = _run(thread, order, facts, run_id, confirmation)
        outcome = _with_spindle(thread, outcome)
    _conclude(outcome, order, facts)


def _require_answers(order: StreamOrder) -> None:
    """Refuse what cannot be asked for here, before anything is done."""
    if order.recover and order.dry_run:
        raise InputError("--recover and --dry-run exclude each other; allowed: one of them")
    if order.position_confirmed and not order.recover:
        raise InputError("--confirm-position belongs to --recover")
    if order.recover and keyboard() is None and not order.position_confirmed:
        raise InputError(
            "--recover needs a person: run it on a terminal, or say with --confirm-position that the position is right"
        )
    try:
        if order.program.exists() and not order.program.is_dir() and not order.program.is_file():
            raise InputError(f"{order.program} is a pipe or a device; allowed: a file, which can be read again")
        with order.program.open("rb"):
            pass
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None


def _preflight(order: StreamOrder, settings: ControllerSettings | None) -> Preflight:
    """Read the program whole, held against the controller's own figures."""
    stage = f"pre-flight of {order.program.name}"
    with _reporter() as reporter:
        begun = time.monotonic()
        reporter.started(stage)
        facts = preflight(
            order.program, order.profile, settings=settings, on_progress=lambda share: reporter.reached(stage, share)
        )
        reporter.ended(stage, time.monotonic() - begun)
    demand_blocks(facts, order.program.name)
    return facts


def _dry_run(order: StreamOrder) -> None:
    """Let the controller itself read the program."""
    facts = _preflight(order, None)
    print_lines(program_lines(order.program, facts))
    stage = "dry run ($C)"
    with contextlib.closing(Connector(order.profile, order.port_url)()) as driver, _reporter() as reporter:
        begun = time.monotonic()
        reporter.started(stage)
        lines = ProgramReader(order.program, facts.index).lines()
        dry_run(driver, order.port_url, lines, lambda line: reporter.reached(stage, line / max(1, facts.lines)))
        reporter.ended(stage, time.monotonic() - begun)
    print(f"finished: the controller takes all {facts.blocks:,} blocks of {order.program.name}; nothing was moved")


@contextlib.contextmanager
def _reporter() -> Iterator[Reporter]:
    if keyboard() is None:
        yield PlainReporter(sys.stdout)
    else:
        with TerminalReporter(Console()) as bars:
            yield bars


@contextlib.contextmanager
def _mill(order: StreamOrder, folder: Path) -> Iterator[tuple[MillThread, Connector]]:
    """The mill, with its thread running; let go of at the end."""
    connector = Connector(order.profile, order.port_url)
    reentry = Reentry(safe_z_mm=order.profile.safe_z_mm)
    with usable(folder):
        mill = Mill(name=order.profile.name, connect=connector, folder=folder, reentry=reentry)
    thread = MillThread(mill)
    try:
        connector.open_now()
        thread.start()
        yield thread, connector
    finally:
        thread.stop(detach=True)  # all that can be done to make it stand has been done
        connector.close_unused()


def _connected(thread: MillThread, url: str) -> MillSnapshot:
    """Wait for the handshake; what is wrong with the link ends the command."""
    give_up_s = time.monotonic() + _CONNECT_S
    snapshot = thread.snapshot
    while not snapshot.connected:
        if snapshot.problem:
            raise InputError(snapshot.problem)
        if time.monotonic() > give_up_s:
            raise NotAControllerError(url, "no controller answers; check power, cable and baud")
        snapshot = thread.wait_for_change(snapshot.version, 0.5)
    give_up_s = time.monotonic() + _POSITION_S
    while snapshot.status.work_mm is None and time.monotonic() < give_up_s:  # some links never tell
        snapshot = thread.wait_for_change(snapshot.version, 0.2)
    return snapshot


def _new_run(thread: MillThread, order: StreamOrder, facts: Preflight) -> tuple[str, Confirmation]:
    run: RunView = thread.call(lambda mill: mill.park(facts, order.program.resolve(), order.program.name))
    checks = START_CHECKS
    if keyboard() is not None and not order.confirmed:
        checks = confirmed_by_person(START_QUESTIONS)
    return run.id, Confirmation(operator=operator_name(), checks=checks)


def _recovery(thread: MillThread, order: StreamOrder, facts: Preflight) -> tuple[str, Confirmation]:
    """The interrupted run of this program, and a person's word for each check, every time."""
    run = interrupted_run(thread, facts, order.program)
    person = keyboard() is not None
    ready_plan(thread, run, person=person, vouched=order.position_confirmed)
    checks = confirmed_by_person(RECOVER_QUESTIONS) if person else RECOVER_CHECKS
    return run.id, Confirmation(operator=operator_name(), checks=checks)


def _run(thread: MillThread, order: StreamOrder, facts: Preflight, run_id: str, confirmation: Confirmation) -> Outcome:
    keys = keyboard()
    screen: Screen = PlainScreen() if keys is None else LiveScreen(order.program.name)
    modes = contextlib.nullcontext() if keys is None else single_keys(keys)
    with watched_signals(at_once(thread)) as signals, modes, screen:
        if order.recover:
            thread.call(lambda mill: mill.recover(run_id, confirmation))
        else:
            thread.call(lambda mill: mill.start(run_id, confirmation))
        return Follower(thread, run_id, facts, screen, keyboard=keys).follow(signals)


def _with_spindle(thread: MillThread, outcome: Outcome) -> Outcome:
    """After the last line: GRBL tells only now and then that its spindle is off, and a false ON would alarm."""
    give_up_s = time.monotonic() + _SPINDLE_S
    snapshot = outcome.snapshot
    while outcome.ended is Ended.FINISHED and snapshot.status.spindle_on and time.monotonic() < give_up_s:
        snapshot = thread.wait_for_change(snapshot.version, 0.2)
    return dataclasses.replace(outcome, snapshot=snapshot)


def _conclude(outcome: Outcome, order: StreamOrder, facts: Preflight) -> None:
    """The last words, and the exit code by way of an error."""
    status, again = outcome.snapshot.status, order.next_command
    if outcome.words:
        raise FailedError(outcome.words, left_words(status), f"to go on: {again}")
    match outcome.ended:
        case Ended.FINISHED:
            print_lines(
                [
                    f"finished:   {facts.lines:,} lines of {order.program.name}{took_words(outcome.snapshot.run)}; "
                    f"{left_words(status)}"
                ]
            )
            return
        case Ended.ABORTED:
            raise StoppedError(f"aborted; {left_words(status)}", f"to go on: {again}")
        case Ended.LEFT:
            raise StoppedError(f"left held on request; {left_words(status)}", f"to go on: {again}")
        case Ended.ABANDONED:
            raise StoppedError(
                "THE MILL MAY STILL MOVE: it was told to hold and has not said that it stands. Use its own stop button",
                f"afterwards: {again}",
            )
    run, progress = outcome.snapshot.run, outcome.snapshot.progress
    cause = (run.words if run is not None else "") or outcome.snapshot.problem or status.detail
    raise FailedError(
        f"{cause}; cut for certain up to line {progress.executed_line:,} of {facts.lines:,}",
        left_words(status),
        f"to go on: {again}",
    )
