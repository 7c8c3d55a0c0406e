"""The API process with traps: killed as by kill -9 at the point that the file $CRASH_AT names.

A point is `before` or `after` and a step of POST jobs or POST runs. As long as there is no such file nothing happens.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from service.server.api import main
from service.server.api.intake import form
from service.server.api.routes import submit
from service.server.api.services import Services
from service.server.database import jobs
from service.server.fleet.agent_client import AgentLink

JOB_STEPS = ("part", "request", "check", "store", "create", "event", "engine", "answer")
RUN_STEPS = ("row", "ask", "put", "post", "parked", "handed")


def points(steps: tuple[str, ...]) -> list[str]:
    """Before the first step and after each: the others lie before the same writes."""
    return [f"before {steps[0]}", *(f"after {step}" for step in steps)]


def _trap(point: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        if Path(os.environ["CRASH_AT"]).read_text(encoding="ascii") == point:
            os.kill(os.getpid(), signal.SIGKILL)


def _set(owner: object, name: str, step: str) -> None:
    """Put a trap before and after a function of a module, a class or an object."""
    function: Callable[..., Any] = getattr(owner, name)

    @functools.wraps(function)
    def trapped(*arguments: Any, **named: Any) -> Any:
        _trap(f"before {step}")
        try:
            return function(*arguments, **named)
        finally:  # the engine has no tables where no worker was ever started
            _trap(f"after {step}")

    @functools.wraps(function)
    async def trapped_async(*arguments: Any, **named: Any) -> Any:
        _trap(f"before {step}")
        try:
            return await function(*arguments, **named)
        finally:
            _trap(f"after {step}")

    setattr(owner, name, trapped_async if inspect.iscoroutinefunction(function) else trapped)


def _everywhere() -> None:
    _set(form._Reader, "_take_content", "part")
    _set(submit, "job_request", "request")
    _set(submit, "read_view", "answer")
    _set(jobs, "write_event", "event")  # inside the transaction
    for name, step in (("get", "ask"), ("put", "put"), ("post", "post")):
        _set(AgentLink, name, step)


def _in(services: Services) -> None:
    _set(services.pictures, "check", "check")
    _set(services.store, "put_file", "store")
    _set(services.book, "create", "create")
    _set(services.engine, "submit", "engine")
    _set(services.fleet._core.runs, "create", "row")
    _set(services.fleet._core.runs, "confirm_parked", "parked")
    _set(services.fleet, "park", "handed")


if __name__ == "__main__":
    opened = main.open_services

    @contextlib.contextmanager
    def with_traps(*given: Any) -> Iterator[Services]:
        with opened(*given) as services:
            _in(services)
            yield services

    _everywhere()
    main.open_services = with_traps
    sys.exit(main.main())
