"""The logs of the server's processes on stderr, with the ids of job, attempt, stage and executor: one line of JSON for
each entry, or short lines for a person at a terminal.
"""

from __future__ import annotations

import logging
import sys

import structlog

Processors = list[structlog.typing.Processor]


def configure_logs(level: str, *, form: str, **ids: object) -> None:
    """Send the entries of structlog, and those of libraries (warnings and worse), to stderr. `ids` are in every line.

    form : of settings.log_format
    """
    for_people = form == "text" or (form == "auto" and sys.stderr.isatty())
    shared: Processors = [
        lambda _logger, _method, event: {**ids, **event},
        structlog.contextvars.merge_contextvars,
        structlog.processors.add_log_level,
    ]
    shared, last = (_people if for_people else _json)(shared)
    number = logging.getLevelNamesMapping()[level.upper()]
    structlog.configure(
        processors=[*shared, last],
        wrapper_class=structlog.make_filtering_bound_logger(number),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name],
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, last],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(max(number, logging.WARNING))


def _json(shared: Processors) -> tuple[Processors, structlog.typing.Processor]:
    stamp = structlog.processors.TimeStamper(fmt="iso", utc=True)
    return [*shared, stamp, structlog.processors.format_exc_info], structlog.processors.JSONRenderer()


def _people(shared: Processors) -> tuple[Processors, structlog.typing.Processor]:
    """Return time of day, level and event, without colours, which a pager would show as escape codes."""
    stamp = structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False)
    plain = structlog.dev.plain_traceback
    return [*shared, stamp], structlog.dev.ConsoleRenderer(colors=False, exception_formatter=plain)
