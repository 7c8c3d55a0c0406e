"""JSON bodies, read by hand: every key is known, every value in its range, or the refusal names it.

No pydantic: the agent shares its memory budget with the streamer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection

from starlette.requests import ClientDisconnect, Request

from service.http.problems import Problem

_MAX_BYTES = 65536


class Fields:
    """The keys of one JSON object; each is taken once, `done` refuses those that nobody took."""

    def __init__(self, values: dict[str, object]) -> None:
        self._values = dict(values)
        self._taken: set[str] = set()

    def has(self, name: str) -> bool:
        return name in self._values

    def text(self, name: str, default: str | None = None, *, allowed: Collection[str] = (), longest: int = 500) -> str:
        value = self._take(name, default)
        if not isinstance(value, str) or not value.strip() or len(value) > longest:
            raise Problem(422, f"{name} is {_shorten(value)}; allowed: a text of 1 to {longest} characters", field=name)
        if allowed and value not in allowed:
            raise Problem(422, f"{name} is {_shorten(value)}; allowed: {', '.join(sorted(allowed))}", field=name)
        return value

    def number(self, name: str, low: float, high: float, default: float | None = None) -> float:
        value = self._take(name, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not _within(value, low, high):
            raise Problem(422, f"{name} is {_shorten(value)}; allowed: {low:g} to {high:g}", field=name)
        return float(value)

    def flag(self, name: str, default: bool | None = None) -> bool:
        value = self._take(name, default)
        if not isinstance(value, bool):
            raise Problem(422, f"{name} is {_shorten(value)}; allowed: true, false", field=name)
        return value

    def triple(self, name: str, limit: float) -> tuple[float, float, float]:
        """Return three numbers between -limit and limit."""
        value = self._take(name, None)
        good = isinstance(value, list) and len(value) == 3
        numbers = value if good and isinstance(value, list) else []
        if not good or any(
            isinstance(number, bool) or not isinstance(number, int | float) or not _within(number, -limit, limit)
            for number in numbers
        ):
            raise Problem(
                422, f"{name} is {_shorten(value)}; allowed: three numbers, {-limit:g} to {limit:g}", field=name
            )
        x, y, z = (float(number) for number in numbers)
        return (x, y, z)

    def texts(self, name: str, allowed: Collection[str]) -> frozenset[str]:
        """Return a list of words out of `allowed`."""
        value = self._take(name, None)
        if not isinstance(value, list) or not all(isinstance(word, str) and word in allowed for word in value):
            words = ", ".join(sorted(allowed))
            raise Problem(422, f"{name} is {_shorten(value)}; allowed: a list of {words}", field=name)
        return frozenset(value)

    def refuse_unknown(self) -> None:
        if unknown := sorted(set(self._values) - self._taken):
            allowed = ", ".join(sorted(self._taken)) or "none"
            raise Problem(422, f"{unknown[0]} is not a key here; allowed: {allowed}", field=unknown[0])

    def _take(self, name: str, default: object) -> object:
        self._taken.add(name)
        if name not in self._values and default is None:
            raise Problem(422, f"{name} is missing", field=name)
        return self._values.get(name, default)


async def read_fields(request: Request) -> Fields:
    """Read the JSON object of a request; an empty body is an empty object."""
    content = bytearray()
    try:
        async for chunk in request.stream():
            content += chunk
            if len(content) > _MAX_BYTES:
                raise Problem(413, f"the body is longer than {_MAX_BYTES} bytes")
    except ClientDisconnect:
        raise Problem(400, "the connection ended before the body did") from None
    if not content.strip():
        return Fields({})
    try:
        values = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise Problem(400, f"the body is not JSON: {str(error)[:100]}") from None
    if not isinstance(values, dict):
        raise Problem(400, "the body is not a JSON object")
    return Fields(values)


def _within(value: float, low: float, high: float) -> bool:
    return math.isfinite(value) and low <= value <= high


def _shorten(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."
