"""`stream --dry-run`: the controller itself reads the whole program in check mode ($C); nothing moves.

Needs no journal, so it works on the driver alone, in this thread.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from machines.clock import Timeout
from machines.driver import (
    CheckMode,
    CommandDone,
    Driver,
    Event,
    Faulted,
    MillState,
    MillStatus,
    ProgramDone,
    ProgramLine,
    allow_always,
)
from machines.errors import MachineError, NotAControllerError
from service.errors import FailedError

CONNECT_S = 90.0  # the driver gives a link up that tells nothing, sooner, and says why
_MODE_S = 60.0  # and ends a command that is not answered
_POLL_S = 0.2


def run_check_mode(
    driver: Driver, url: str, lines: Iterator[ProgramLine], on_line: Callable[[int], None]
) -> tuple[str, ...]:
    """Send all lines in check mode; returns the protections that were active. FailedError names what was refused."""
    driver.connect()
    _poll_until(
        driver, url, CONNECT_S, lambda _: driver.status.state not in (MillState.CONNECTING, MillState.DISCONNECTED)
    )
    if driver.status.state is not MillState.IDLE:
        raise FailedError(f"dry run: the mill is {driver.status.state.value}; allowed when it is idle")
    _set_check_mode(driver, url, on=True)
    protections = driver.protections
    try:
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
    """Check mode on or off, confirmed."""
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
    """Leave check mode, whatever state the stream is in; a controller that cannot be told is named."""
    try:
        if driver.progress.streaming:
            driver.abort()
            _poll_until(driver, url, _MODE_S, lambda _: not driver.progress.streaming)
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
    """Return the error for a link that is neither ready nor given up after so long, with what it waits for."""
    detail = f" ({status.detail})" if status.detail else ""
    return NotAControllerError(url, f"the mill is still {status.state.value}{detail}; given up")
