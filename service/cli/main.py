"""Entry point of the command `causticmill`: run it and translate every error and signal.

Each error gives one line on stderr and an exit code: 2 for wrong input, 1 for a failed job, 130 for Ctrl-C. This module
imports only the standard library, so that an interrupt during a slow start is handled as well.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from types import FrameType

from service.errors import EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED, ServiceError, printable, sentence_of_os_error
from service.job.files import STOPPING_SIGNALS
from service.processes.kernel_cache import use_current_kernels

_AGAIN_S = 1.0
_SOON_S = 0.01


def main() -> None:
    """Run the installed command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a file may have a name that this terminal cannot show
    gc.set_threshold(100_000, 20, 20)  # imports make nearly all objects, and these stay: frequent collection is useless
    code = run(sys.argv[1:])
    for kind in (
        *STOPPING_SIGNALS,
        signal.SIGHUP,
    ):  # the work is done; a signal now ends the process without a traceback
        if signal.getsignal(kind) is not signal.SIG_IGN:
            signal.signal(kind, signal.SIG_DFL)
    if code == EXIT_INTERRUPTED:  # clean-up is done, and the interpreter would wait for computing threads
        sys.stdout.flush()
        os._exit(code)
    gc.freeze()  # otherwise the interpreter collects once more at its end: a second after a lens
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; every error becomes one line on stderr."""
    with _raise_interrupts() as signals:
        code, error, interrupted = EXIT_FAILURE, None, False
        try:
            try:
                code = _run_command(arguments)
            except Exception as raised:
                error = raised
            signals.over = True
        except KeyboardInterrupt:
            interrupted = True
        signals.over = True  # from here on nothing is raised, so that the last message is complete
        if isinstance(error, ServiceError) and error.exit_code == EXIT_INTERRUPTED:  # its message says what is left
            return _report_error(error)
        if interrupted or code == EXIT_INTERRUPTED or (error is not None and signals.received):
            # even if an import or a library changed the error; typer also catches Ctrl-C itself, silently
            return _fail("interrupted; no half-written file is left", EXIT_INTERRUPTED)
        return code if error is None else _report_error(error)


def _run_command(arguments: Sequence[str]) -> int:
    use_current_kernels()
    from service.cli.app import app

    result = app(args=list(arguments), prog_name="causticmill", standalone_mode=False)
    return result if isinstance(result, int) else 0


def _report_error(error: Exception) -> int:
    """Return the error that ended a command as a line for stderr, and the exit code. An error of the program itself is
    raised again.
    """
    match error:
        case ServiceError():
            return _fail(str(error), error.exit_code)
        case MemoryError():
            return _fail("out of memory; a smaller image.pixels needs less", EXIT_FAILURE)
        case BrokenPipeError():
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return EXIT_FAILURE
        case OSError():
            return _fail(sentence_of_os_error(error, doing="cannot use"), EXIT_FAILURE)
    if (message := getattr(error, "format_message", None)) is not None:  # a usage error from the parser
        return _fail(printable(" ".join(str(message()).split())), EXIT_INPUT)
    raise error


def _fail(text: str, code: int) -> int:
    for line in text.split("\n"):
        print(f"error: {line}", file=sys.stderr)
    return code


class _Signals:
    """`received`: the numbers so far; `over`: the command has ended, and a signal changes nothing any more."""

    def __init__(self) -> None:
        self.received: list[int] = []
        self.over = False


@contextlib.contextmanager
def _raise_interrupts() -> Iterator[_Signals]:
    """End a command on SIGTERM and a lost terminal as Ctrl-C does. A signal that is ignored (nohup) stays so.

    Further signals change nothing, so that clean-up is not cut short. An import or a callback may swallow the
    interrupt, so an alarm raises it again until the command has ended. The compiler may finish first: its callbacks
    swallow an interrupt and return an empty kernel instead, which is then called.
    """
    signals = _Signals()

    def interrupt(number: int, frame: FrameType | None) -> None:
        if signals.over:
            return
        signals.received.append(number)
        if len(signals.received) == 1:
            sys.unraisablehook = lambda _: None  # callbacks and destructors of the compiler would report it
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S, _AGAIN_S)
        if len(signals.received) > 1 and number != signal.SIGALRM:
            return
        if _is_compiling(frame):
            signal.setitimer(signal.ITIMER_REAL, _SOON_S, _AGAIN_S)
        else:
            raise KeyboardInterrupt

    hook = sys.unraisablehook
    kinds = [kind for kind in (*STOPPING_SIGNALS, signal.SIGHUP) if signal.getsignal(kind) is not signal.SIG_IGN]
    try:
        before = {kind: signal.signal(kind, interrupt) for kind in kinds}
    except ValueError:  # not in the main thread
        yield signals
        return
    try:
        yield signals
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        sys.unraisablehook = hook
        for kind, handler in before.items():
            signal.signal(kind, handler)


def _is_compiling(frame: FrameType | None) -> bool:
    """Return whether this frame was called by the compiler, or is part of it."""
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("llvmlite."):
            return True
        frame = frame.f_back
    return False


if __name__ == "__main__":
    main()
