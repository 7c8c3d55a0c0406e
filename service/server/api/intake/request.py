"""Parses the form of a new job: the resolved spec, the priority, the hash of the whole request."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from typing import Any

from phrases.phrase import Phrase
from service.errors import SpecError
from service.http.problems import Kind, Problem
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import ResolvedJob
from service.job.spec.section import RuleError
from service.server.api.access.guard import Principal
from service.server.api.intake.form import JobForm
from service.server.database.records import NORMAL, PRIORITIES, ClientKey

_DEEPEST = 20
_TOO_DEEP = Phrase("the part 'spec' is nested too deeply")
_MOST_VALUES = 20_000  # a measured light has 128 x 128, all the rest of a spec a few hundred


@dataclass(frozen=True, slots=True, kw_only=True)
class JobRequest:
    """A caller's request, with the figures for its names; sha256 covers everything that the caller sent except the
    picture's file name.
    """

    spec: dict[str, Any]
    figures: str
    priority: int
    sha256: str


def job_request(form: JobForm) -> JobRequest:
    """Parse a request; SpecError or Problem for unusable values."""
    job = _resolve(bytes(form.texts.get("spec", b"")))
    spec = job.spec.model_dump(mode="json")
    priority = _priority(form.texts.get("priority"))
    whole = [form.image_sha256, spec, priority]
    digest = hashlib.sha256(json.dumps(whole, sort_keys=True, separators=(",", ":")).encode())
    return JobRequest(spec=spec, figures=job.figures.to_text(), priority=priority, sha256=digest.hexdigest())


def idempotency_key(header: str | None, principal: Principal) -> ClientKey | None:
    """Return the header's value as this caller's key, if it is one of 1 to 200 printable ASCII characters."""
    if header is None:
        return None
    key = header.strip()
    if not 1 <= len(key) <= 200 or not (key.isascii() and key.isprintable()):
        raise Problem(422, Phrase("the key must be 1 to 200 printable ASCII characters"), field="Idempotency-Key")
    return ClientKey(principal.id, key)


def _resolve(text: bytes) -> ResolvedJob:
    data = _parse(text) if text.strip() else {}
    try:
        return resolve_job(base=data)
    except SpecError:
        raise
    except (TypeError, ValueError, KeyError, AttributeError, RecursionError, ArithmeticError) as error:
        raise Problem(
            422,
            Phrase("the spec has the wrong structure: it must be a JSON object of tables and values"),
            field="spec",
            kind=Kind.SPEC,
        ) from error


def _parse(text: bytes) -> dict[str, Any]:
    """Parse a JSON object. Valid JSON that no one intends is refused: duplicate keys, NaN, deep nesting.

    The values are counted before they are parsed, because this process pays for each of them from here on.
    """
    if text.count(b",") + text.count(b":") > _MOST_VALUES:
        raise _unusable(Phrase("the part 'spec' holds more than {most} values", most=_MOST_VALUES))
    try:
        data = json.loads(
            text.decode("utf-8-sig"), object_pairs_hook=_refuse_duplicates, parse_constant=_refuse_constant
        )
    except UnicodeDecodeError:
        raise _unusable(Phrase("the part 'spec' is not UTF-8")) from None
    except RecursionError:
        raise _unusable(_TOO_DEEP) from None
    except ValueError as error:
        cause = error.words if isinstance(error, RuleError) else " ".join(str(error).split())[:120]
        raise _unusable(Phrase("the part 'spec' is not JSON: {cause}", cause=cause)) from None
    if not isinstance(data, dict):
        raise _unusable(Phrase("the part 'spec' must be a JSON object"))
    if _depth(data) > _DEEPEST:
        raise _unusable(_TOO_DEEP)
    return data


def _refuse_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for key, value in pairs:
        if key in made:
            raise RuleError(Phrase("the key '{key}' is given twice", key=" ".join(key[:60].split())))
        made[key] = value
    return made


def _refuse_constant(word: str) -> float:
    raise RuleError(Phrase("{word} is not a number", word=word))


def _depth(value: object) -> int:
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if inner is None else 1 + max(map(_depth, inner), default=0)


def _unusable(words: Phrase) -> Problem:
    return Problem(422, words, field="spec", kind=Kind.SPEC)


def _priority(text: bytearray | None) -> int:
    if text is None or not text.strip():
        return NORMAL
    word = text.decode("utf-8", "replace").strip()
    if word not in PRIORITIES:
        words = Phrase("priority is '{word}'; allowed: {allowed}", word=word[:40], allowed=", ".join(PRIORITIES))
        raise Problem(422, words, field="priority")
    return PRIORITIES[word]
