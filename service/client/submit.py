"""A picture and its spec handed to the server, exactly once however often the answer is lost."""

from __future__ import annotations

import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.client.follow import LeftError
from service.client.server import Server, misunderstood
from service.errors import InputError, sentence_of_os_error

PRIORITIES = ("low", "normal", "high")
_PATIENCE_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Submission:
    """spec is JSON, or None for the defaults."""

    picture: Path
    spec: str | None = None
    priority: str = "normal"


def submit(server: Server, order: Submission) -> dict[str, Any]:
    """The new job. The same key goes with every try, so that the server makes one job of them."""
    if order.priority not in PRIORITIES:
        raise InputError(f"--priority: '{order.priority}' is not allowed; allowed: {', '.join(PRIORITIES)}")
    key = str(uuid.uuid4())
    try:
        return dict(server.patiently(lambda: _posted(server, order, key), patience_s=_PATIENCE_S))
    except KeyboardInterrupt:
        raise LeftError("interrupted before the server had answered; `causticmill jobs` tells if it is known") from None


def _posted(server: Server, order: Submission, key: str) -> dict[str, Any]:
    form = {"priority": order.priority} | ({"spec": order.spec} if order.spec is not None else {})
    try:
        with order.picture.open("rb") as picture:
            if not order.picture.is_file():
                raise InputError(f"{order.picture} is a pipe or a device; allowed: a file, which can be read again")
            answer = server.send(
                "POST",
                "/v1/jobs",
                data=form,
                files={"image": (order.picture.name, picture)},
                headers={"Idempotency-Key": key},
            )
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None
    try:
        job = answer.json()
    except ValueError:
        job = None
    if not isinstance(job, dict) or "id" not in job:
        raise misunderstood(server, answer)
    return job
