"""Entry point of the command `causticmill`: runs it, and translates whatever ends it.

Errors end in one line each on stderr and an exit code: 2 for what the person gave, 1 for a job that failed, 130 for
Ctrl-C. Only what the standard library has is imported here, so that an interrupt of a slow start ends well, too.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

from service.errors import EXIT_FAILURE, EXIT_INPUT, EXIT_INTERRUPTED, JobError, printable, sentence_of_os_error
from service.kernel_cache import use_current_kernels

_STOPS = (signal.SIGINT, signal.SIGTERM)


def main() -> None:
    """What the installed command calls."""
    code = run(sys.argv[1:])
    if code == EXIT_INTERRUPTED:  # all is cleaned up, and the interpreter would wait for threads still computing
        sys.stdout.flush()
        os._exit(code)
    sys.exit(code)


def run(arguments: Sequence[str]) -> int:
    """Run a command line and return its exit code; every error becomes one line on stderr."""
    with _one_interrupt():
        return _told(lambda: _command(arguments))


def _command(arguments: Sequence[str]) -> Any:
    use_current_kernels()
    from service.commands import app

    return app(args=list(arguments), prog_name="causticmill", standalone_mode=False)


def _told(command: Callable[[], Any]) -> int:
    """Run a command; translate whatever ends it into a line and an exit code."""
    try:
        result = command()
        if result == EXIT_INTERRUPTED:  # typer catches Ctrl-C itself and says nothing
            raise KeyboardInterrupt
        return result if isinstance(result, int) else 0
    except JobError as error:
        return _fail(str(error), error.exit_code)
    except KeyboardInterrupt:
        return _fail("interrupted; nothing half-written is left", EXIT_INTERRUPTED)
    except MemoryError:
        return _fail("out of memory; a smaller image.pixels needs less", EXIT_FAILURE)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_FAILURE
    except OSError as error:
        return _fail(sentence_of_os_error(error, doing="cannot use"), EXIT_FAILURE)
    except Exception as error:
        if (message := getattr(error, "format_message", None)) is not None:  # a usage error from the parser
            return _fail(printable(" ".join(str(message()).split())), EXIT_INPUT)
        raise


def _fail(text: str, code: int) -> int:
    for line in text.split("\n"):
        print(f"error: {line}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _one_interrupt() -> Iterator[None]:
    """SIGTERM cleans up as Ctrl-C does; a second of either changes nothing, so that the cleaning is not cut short."""

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for kind in _STOPS:
            signal.signal(kind, signal.SIG_IGN)
        raise KeyboardInterrupt

    try:
        before = {kind: signal.signal(kind, interrupt) for kind in _STOPS}
    except ValueError:  # not in the main thread
        yield
        return
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


if __name__ == "__main__":
    main()
