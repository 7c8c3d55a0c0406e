"""What a page is told in place of the server's answer is held against the API's document, so that it cannot lie."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock
from urllib.parse import urlsplit

from jsonschema import Draft202012Validator
from playwright.sync_api import Route

from service.http.problems import Problem, problem_body
from tests.service.server.api.test_openapi import SNAPSHOT

_EVENTS = {"status": "MachineView", "log": "PastOrder"}  # of a machine's stream


@functools.cache
def _document() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(SNAPSHOT.read_text(encoding="utf-8"))
    return found


@functools.cache
def _validator(where: str) -> Draft202012Validator:
    """By a path of keys into the document, or the name of a schema."""
    schema = {"$ref": f"#/components/schemas/{where}"} if "/" not in where else {"$ref": f"#/{where}"}
    return Draft202012Validator(schema | {"components": _document()["components"], "paths": _document()["paths"]})


@functools.cache
def _operations() -> list[tuple[re.Pattern[str], str]]:
    """Every path as a pattern, those with fewer unknown parts first."""
    paths = sorted(_document()["paths"], key=lambda path: path.count("{"))
    return [(re.compile(re.sub(r"\\{\w+\\}", "[^/:]+", re.escape(path))), path) for path in paths]


def _path_of(address: str) -> str:
    return next((path for pattern, path in _operations() if pattern.fullmatch(address)), "")


def lies_of(method: str, url: str, *, status: int, kind: str, body: str | bytes) -> list[str]:
    """What of this answer the server would never say, a sentence for each."""
    address = urlsplit(url).path
    path = _path_of(address)
    if not address.startswith("/v1/"):
        return []
    told = _document()["paths"].get(path, {}).get(method.lower(), {}).get("responses", {}).get(str(status))
    name = f"{method} {address} {status}"
    if told is None:
        return [f"{name}: the API has no such answer"]
    if status >= 400:
        right = kind.startswith("application/problem+json")
        faults = _faults("Problem", body) if right else [f"it is {kind or 'nothing'}, no problem of the server's"]
    elif "application/json" not in told.get("content", {}) or not kind.startswith("application/json"):
        faults = _event_faults(body) if kind.startswith("text/event-stream") and "/machines/" in address else []
    else:
        parts = ("paths", path, method.lower(), "responses", str(status), "content", "application/json", "schema")
        faults = _faults("/".join(part.replace("~", "~0").replace("/", "~1") for part in parts), body)
    return [f"{name}: {fault}" for fault in faults]


def asked_wrongly(method: str, url: str, body: str | None) -> list[str]:
    """What of this request the server would not take."""
    path = _path_of(urlsplit(url).path)
    told = _document()["paths"].get(path, {}).get(method.lower(), {}).get("requestBody", {}).get("content", {})
    if "application/json" not in told:
        return []
    parts = ("paths", path, method.lower(), "requestBody", "content", "application/json", "schema")
    faults = _faults("/".join(part.replace("~", "~0").replace("/", "~1") for part in parts), body or "null")
    return [f"{method} {urlsplit(url).path} asked with {body}: {fault}" for fault in faults]


def _faults(where: str, body: str | bytes) -> list[str]:
    found = json.loads(body or "null")
    return [f"{error.json_path}: {error.message[:200]}" for error in _validator(where).iter_errors(found)]


def _event_faults(body: str | bytes) -> list[str]:
    text = body.decode() if isinstance(body, bytes) else body
    events = re.findall(r"event: (\w+)\ndata: (.*)\n\n", text)
    return [fault for name, data in events if name in _EVENTS for fault in _faults(_EVENTS[name], data)]


def problem(status: int, **told: Any) -> dict[str, Any]:
    """What a route is fulfilled with where the server refuses."""
    body = problem_body(Problem(status, told.pop("detail"), more=told))
    return {"status": status, "body": json.dumps(body), "content_type": "application/problem+json"}


@contextmanager
def watched_answers() -> Iterator[list[str]]:
    """Lies of all that tests tell their pages by `route.fulfill` meanwhile, and orders that no server would take."""
    lies: list[str] = []
    fulfil = Route.fulfill

    def check(route: Route, **told: Any) -> None:
        asked, status = route.request, told.get("status") or 200
        if "json" in told and status >= 400:
            told = problem(status, **{key: value for key, value in told["json"].items() if key != "status"})
        body = json.dumps(told["json"]) if "json" in told else told.get("body") or ""
        kind = "application/json" if "json" in told else told.get("content_type", "")
        lies.extend(lies_of(asked.method, asked.url, status=status, kind=kind, body=body))
        if status < 300 and "json" in asked.headers.get("content-type", ""):
            lies.extend(asked_wrongly(asked.method, asked.url, asked.post_data))
        fulfil(route, **told)

    with mock.patch.object(Route, "fulfill", check):
        yield lies
