"""`causticmill stream`: one program on one mill, from pre-flight to the last line, watched from this terminal.

Order: open the link, which moves nothing; read the whole program and check it against the controller's own settings;
show the person what matters. Nothing moves before the person agrees, at the terminal or by --yes on the command line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from machines.clock import Timeout
from machines.driver import MillStatus
from machines.errors import MachineError
from machines.gcode.lift import LIFT_MM
from machines.gcode.program import ProgramReader
from machines.grbl.link import SILENT
from machines.grbl.settings import ControllerSettings
from machines.mill.mill import Mill
from machines.mill.thread import MillThread
from machines.mill.view import MillSnapshot
from machines.preflight.preflight import Preflight
from machines.profile import MachineProfile
from machines.recovery.plan_model import Reentry
from machines.runs import START_CHECKS, Confirmation, RunReport
from service.errors import EXIT_INTERRUPTED, FailedError, InputError, ServiceError, sentence_of_os_error
from service.milling.agent.settings import mill_folder, report_disk_errors
from service.milling.connect import Connector, demand_blocks
from service.milling.preflight import run_preflight, write_dry_pass
from service.milling.terminal.confirm import (
    FRAME_QUESTIONS,
    RECOVER_QUESTIONS,
    START_QUESTIONS,
    ask_person,
    give_order,
    operator_name,
    require_answers,
)
from service.milling.terminal.follow import Ended, Outcome, RunFollower, find_keyboard, make_immediate_hold
from service.milling.terminal.keys import list_heard_signals, single_keys, watch_signals
from service.milling.terminal.leaving import (
    STILL_HELD,
    Buffers,
    await_status,
    clear_at_the_end,
    ignore_signals,
    ignore_signals_for_good,
    is_partly_unknown,
)
from service.milling.terminal.ready import (
    CONNECT_S,
    find_interrupted_run,
    frame_job,
    make_unconnected_error,
    prepare_mill,
    prepare_plan,
    reset_silent_mill,
    run_check_mode,
)
from service.milling.terminal.screen import (
    LiveScreen,
    PlainScreen,
    Screen,
    describe_mill_left,
    mill_lines,
    print_lines,
    program_lines,
    spindle_lines,
    stop_lines,
    stream_command,
    took_words,
)
from service.processes.files import keep_private
from service.progress import PlainReporter, Reporter, TerminalReporter

_BOOT_S = 3.0  # how long a board that restarts when its port is opened stays silent
_POSITION_S = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamOrder:
    """The options of the command line. port_given is None if the profile's own port is meant."""

    program: Path
    profile: MachineProfile
    port_url: str
    port_given: str | None
    confirmed: bool = False
    recover: bool = False
    position_confirmed: bool = False
    frame: bool = False
    dry_run: bool = False
    lift_mm: float | None = None  # of a dry pass

    @property
    def questions(self) -> dict[str, str]:
        """Return the questions that a person has to confirm, by check."""
        return RECOVER_QUESTIONS if self.recover else START_QUESTIONS

    @property
    def given(self) -> frozenset[str]:
        """Return the checks that the command line confirms."""
        position = frozenset({"position"} if self.position_confirmed else ())
        return (START_CHECKS if self.confirmed else frozenset()) | position

    @property
    def next_command(self) -> str:
        again = "--recover" if self.lift_mm is None else f"--dry-pass {self.lift_mm:g}"
        return stream_command(self.program, self.port_given, self.profile.name, again)


class StoppedError(ServiceError):
    """The run was stopped by a signal or by the person."""

    exit_code = EXIT_INTERRUPTED


def stream_program(order: StreamOrder) -> None:
    """Run the program. Return when it is finished; raise a JobError in every other case."""
    _require_answers(order)
    with _lift_program(order) as lifted:
        _stream(lifted)


def _stream(order: StreamOrder) -> None:
    if order.dry_run:
        _run_in_check_mode(order)
        return
    folder = keep_private(mill_folder(order.profile.name, own_port=order.profile.link.port, port_url=order.port_url))
    if find_keyboard() is None:
        print_lines(stop_lines(list_heard_signals()))
    outcome, facts = _run_on_mill(order, folder)
    _conclude(outcome, order, facts)


@contextlib.contextmanager
def _lift_program(order: StreamOrder) -> Iterator[StreamOrder]:
    """Write the program of a dry pass into a folder of its own, kept while it runs; for any other run do nothing."""
    if order.lift_mm is None:
        yield order
        return
    with tempfile.TemporaryDirectory(prefix="causticmill-dry-") as folder:
        path = Path(folder) / f"{order.program.stem}-{order.lift_mm:g}mm-up{order.program.suffix}"
        write_dry_pass(order.program, order.profile, order.lift_mm, path)
        yield dataclasses.replace(order, program=path)


def _run_on_mill(order: StreamOrder, folder: Path) -> tuple[Outcome, Preflight]:
    """Run the program and release the mill."""
    with (
        _open_mill(order, folder) as (thread, connector),
        clear_at_the_end(thread, order.next_command) as buffers,
    ):
        snapshot = _await_mill(thread, buffers, order.port_url)
        print_lines(mill_lines(order.port_url, snapshot.status, snapshot.protections, snapshot.facts))
        print_lines(spindle_lines(order.profile))
        if not order.recover:
            prepare_mill(thread, buffers, person=find_keyboard() is not None)
        facts = _preflight(order, connector.settings)
        print_lines(program_lines(order.program, facts))
        prepare = _prepare_recovery if order.recover else _prepare_new_run
        run_id, begin = prepare(thread, buffers, order, facts)
        ignore_signals_for_good()  # a Ctrl-C held down must not cut off the last lines; `_run` watches for it meanwhile
        return _settle(thread, _run(thread, buffers, order, facts, run_id, begin)), facts


def _require_answers(order: StreamOrder) -> None:
    """Refuse before anything is done if a question must be asked but cannot be."""
    if order.recover and order.dry_run:
        raise InputError("--recover and --dry-run exclude each other; allowed: one of them")
    if order.frame and (order.recover or order.dry_run):
        raise InputError("--frame belongs to a program that starts from its top, without --recover or --dry-run")
    if order.lift_mm is not None:
        low, high = LIFT_MM
        if order.recover:
            raise InputError("--dry-pass and --recover exclude each other: a dry pass begins at its top")
        if not low <= order.lift_mm <= high:
            raise InputError(f"--dry-pass {order.lift_mm:g}: allowed: {low:g} to {high:g} mm")
    if order.position_confirmed and not order.recover:
        raise InputError("--confirm-position belongs to --recover")
    try:
        if order.program.exists() and not order.program.is_dir() and not order.program.is_file():
            raise InputError(f"{order.program} is a pipe or a device; allowed: a file, which can be read again")
        with order.program.open("rb"):
            pass
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None
    if find_keyboard() is None and not order.dry_run:
        require_answers(order.questions, order.given)


def _preflight(order: StreamOrder, settings: ControllerSettings | None) -> Preflight:
    """Read the whole program and check it against the controller's own figures."""
    stage = f"pre-flight of {order.program.name}"
    with _open_reporter() as reporter:
        begun = time.monotonic()
        reporter.start_stage(stage)
        facts = run_preflight(
            order.program,
            order.profile,
            settings=settings,
            dry_pass=order.lift_mm is not None,
            on_progress=lambda share: reporter.report_share(stage, share),
        )
        reporter.end_stage(stage, time.monotonic() - begun)
    demand_blocks(facts, order.program.name)
    return facts


def _run_in_check_mode(order: StreamOrder) -> None:
    """Let the controller itself check the program ($C)."""
    facts = _preflight(order, None)
    print_lines(program_lines(order.program, facts))
    stage = "dry run ($C)"
    with contextlib.closing(Connector(order.profile, order.port_url)()) as driver, _open_reporter() as reporter:
        begun = time.monotonic()
        reporter.start_stage(stage)
        lines = ProgramReader(order.program, facts.index).lines()
        run_check_mode(
            driver, order.port_url, lines, lambda line: reporter.report_share(stage, line / max(1, facts.lines))
        )
        reporter.end_stage(stage, time.monotonic() - begun)
    print(f"finished: the controller takes all {facts.blocks:,} blocks of {order.program.name}; nothing was moved")


@contextlib.contextmanager
def _open_reporter() -> Iterator[Reporter]:
    if find_keyboard() is None:
        yield PlainReporter(sys.stdout)
    else:
        with TerminalReporter(Console()) as bars:
            yield bars


@contextlib.contextmanager
def _open_mill(order: StreamOrder, folder: Path) -> Iterator[tuple[MillThread, Connector]]:
    """Open the mill with its thread running; release it at the end."""
    connector = Connector(order.profile, order.port_url)
    reentry = Reentry(safe_z_mm=order.profile.safe_z_mm)
    with report_disk_errors(folder):
        mill = Mill(name=order.profile.name, connect=connector, folder=folder, reentry=reentry)
    thread = MillThread(mill)
    try:
        connector.open_now()
        thread.start()
        yield thread, connector
    finally:
        with ignore_signals():
            thread.stop(detach=True)  # everything possible has been done to bring it to a standstill
            connector.close_unused()


def _await_mill(thread: MillThread, buffers: Buffers, url: str) -> MillSnapshot:
    """Wait for the handshake; a fault of the link ends the command. If nothing answers, offer one reset."""
    booting, timeout = Timeout(_BOOT_S), Timeout(CONNECT_S)
    snapshot, offered = thread.snapshot, find_keyboard() is None
    while not snapshot.connected:
        silent = booting.is_over and snapshot.status.detail == SILENT
        if silent and not offered:
            offered = True
            reset_silent_mill(thread, buffers)
            timeout.restart()
        elif snapshot.problem:
            raise InputError(snapshot.problem)
        elif timeout.is_over:
            raise make_unconnected_error(url, snapshot.status)
        snapshot = thread.wait_for_change(snapshot.version, 0.2)
    timeout = Timeout(_POSITION_S)
    while snapshot.status.work_mm is None and not timeout.is_over:  # some links never report it
        snapshot = thread.wait_for_change(snapshot.version, 0.2)
    return snapshot


def _prepare_new_run(
    thread: MillThread, buffers: Buffers, order: StreamOrder, facts: Preflight
) -> tuple[str, Callable[[Mill], None]]:
    """Park a run, go around its outline if the order asks for it, and let the person confirm that all is in order.
    Return the run's id and the function that starts it.
    """
    run: RunReport = thread.call(
        lambda mill: mill.park(facts, order.program.resolve(), order.program.name, lift_mm=order.lift_mm)
    )
    if order.frame:
        if not order.confirmed:
            ask_person(FRAME_QUESTIONS)
        frame_job(thread, buffers, run)
    setup = None if order.confirmed else thread.snapshot.setup
    confirmation = _confirm(order)
    return run.id, lambda mill: mill.start(run.id, confirmation, setup=setup)


def _prepare_recovery(
    thread: MillThread, buffers: Buffers, order: StreamOrder, facts: Preflight
) -> tuple[str, Callable[[Mill], None]]:
    """Plan the recovery of this program's interrupted run, and return the function that starts it after a person has
    confirmed.
    """
    run = find_interrupted_run(thread, facts, order.program)
    person = find_keyboard() is not None
    plan = prepare_plan(thread, buffers, run, person=person, vouched=order.position_confirmed)
    confirmation = _confirm(order)
    return run.id, lambda mill: mill.recover(run.id, confirmation, plan_seen=plan.digest)


def _confirm(order: StreamOrder) -> Confirmation:
    """Return a person's confirmation of each check, from the command line or the terminal, never from silence."""
    asked = {check: words for check, words in order.questions.items() if check not in order.given}
    return Confirmation(operator=operator_name(), checks=order.given | ask_person(asked))


def _run(
    thread: MillThread,
    buffers: Buffers,
    order: StreamOrder,
    facts: Preflight,
    run_id: str,
    begin: Callable[[Mill], None],
) -> Outcome:
    keys = find_keyboard()
    screen: Screen = PlainScreen() if keys is None else LiveScreen(order.program.name)
    modes = contextlib.nullcontext() if keys is None else single_keys(keys)
    with watch_signals(make_immediate_hold(thread)) as signals, modes, screen:
        buffers.fill(run_id)
        try:
            give_order(thread, "recover" if order.recover else "start", begin)
        except MachineError:
            if not thread.call(lambda mill: mill.run(run_id).live):
                buffers.mark_empty()  # refused: nothing was sent
            raise
        return RunFollower(thread, buffers, run_id, facts, screen, keyboard=keys).follow(signals)


def _settle(thread: MillThread, outcome: Outcome) -> Outcome:
    """Return the outcome with the final state."""

    def is_open(status: MillStatus) -> bool:
        if outcome.ended is Ended.FINISHED:
            return status.spindle_on is True
        return outcome.cleared and is_partly_unknown(status)

    return dataclasses.replace(outcome, snapshot=await_status(thread, is_open))


def _conclude(outcome: Outcome, order: StreamOrder, facts: Preflight) -> None:
    """Print the last lines, and raise the exit code as an error."""
    status, run = outcome.snapshot.status, outcome.snapshot.run
    held = () if outcome.cleared else (STILL_HELD,)
    stands = describe_mill_left(status)
    left = (*held, stands, f"to go on: {order.next_command}")
    if outcome.words:
        raise FailedError(outcome.words, *left)
    match outcome.ended:
        case Ended.FINISHED:
            print_lines([f"finished:   {facts.lines:,} lines of {order.program.name}{took_words(run)}; {stands}"])
            return
        case Ended.ABORTED:
            raise StoppedError("aborted", *left)
        case Ended.LEFT:
            raise StoppedError("left held on request", *left)
        case Ended.ABANDONED:
            raise StoppedError(
                "THE MILL MAY STILL MOVE: it was sent a hold and has not reported its stop. Use its own stop button",
                *left,
            )
    cause = (run.words if run is not None else "") or outcome.snapshot.problem or status.detail
    executed = run.executed_line if run is not None else 0
    cut = f"cut for certain up to line {executed:,} of {facts.lines:,}" if executed else "no line is cut for certain"
    raise FailedError(f"{cause}; {cut}", *left)
