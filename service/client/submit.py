"""Submit a picture and its spec to the server, exactly once, even if answers are lost."""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.client.follow import LeftError
from service.client.server import ServerClient, make_mismatch_error
from service.errors import InputError, printable, sentence_of_os_error
from service.job.spec.loading import default_layer, spec_data

PRIORITIES = ("low", "normal", "high")
_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Submission:
    """spec is JSON, or None for the defaults."""

    picture: Path
    spec: str | None = None
    priority: str = "normal"


def submit_job(server: ServerClient, order: Submission) -> dict[str, Any]:
    """Submit a job. Every try has the same key, so that the server makes only one job."""
    if order.priority not in PRIORITIES:
        raise InputError(f"--priority: '{order.priority}' is not allowed; allowed: {', '.join(PRIORITIES)}")
    key = str(uuid.uuid4())
    try:
        return dict(server.retry(lambda: _post_form(server, order, key), timeout_s=_TIMEOUT_S))
    except KeyboardInterrupt:
        raise LeftError(
            "interrupted before the server answered; `causticmill jobs` shows whether the job was submitted"
        ) from None


def _post_form(server: ServerClient, order: Submission, key: str) -> dict[str, Any]:
    form = {"priority": order.priority} | ({"spec": order.spec} if order.spec is not None else {})
    try:
        with order.picture.open("rb") as picture:
            if not order.picture.is_file():
                raise InputError(f"{order.picture} is a pipe or a device; allowed: a file, which can be read again")
            answer = server.send(
                "POST",
                "/v1/jobs",
                data=form,
                files={"image": (printable(order.picture.name), picture)},
                headers={"Idempotency-Key": key},
            )
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None
    try:
        job = answer.json()
    except ValueError:
        job = None
    if not isinstance(job, dict) or "id" not in job:
        raise make_mismatch_error(server, answer)
    return job


def spec_text(
    *, file: Path | None, preset: str | None, overrides: Sequence[str], light_picture: Path | None = None
) -> str:
    """Return JSON of file, preset, overrides and the picture of the light, as `make` takes them.

    It is not checked against this computer's profiles, because the mill may be known only to the server.
    """
    said: dict[str, Any] = {"file": file, "preset": preset, "overrides": overrides}
    data = spec_data(**said, base=default_layer(**said), light_picture=light_picture)
    return json.dumps(_plain(data), default=str)


def _plain(value: Any) -> Any:
    """Return values that JSON allows: numbers that only TOML has become text, so that the server can name the key."""
    match value:
        case dict():
            return {str(key): _plain(below) for key, below in value.items()}
        case list() | tuple():
            return [_plain(below) for below in value]
        case float() if not math.isfinite(value):
            return str(value)
    return value
