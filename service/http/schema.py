"""Types for the models of requests and answers. Our own code makes the contents of an answer, so the OpenAPI document
describes words, hashes and times, but answers are not validated against it: a value that another version wrote is
passed on, not refused.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, PlainSerializer
from pydantic_core import CoreSchema, core_schema

from phrases.phrase import phrases_in

Json = dict[str, Any]


class Body(BaseModel):
    model_config = ConfigDict(extra="forbid", from_attributes=True)


def iso_time(at: float) -> str:
    """Return seconds since 1970 as '2026-11-21T08:00:00.123Z'."""
    return datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def one_of(words: Iterable[str]) -> Any:
    """Return the type of a text in an answer that may be one of these words."""
    return Field(json_schema_extra={"enum": [str(word) for word in words]})


class PhraseView(Body):
    """The parts of a sentence: its template, and its values by name, which may be phrases too."""

    template: str
    values: dict[str, str | PhraseView]


def phrase_views(document: Any) -> dict[str, PhraseView]:
    """Return the phrases in the contents of an answer."""
    return {text: PhraseView.model_validate(plain) for text, plain in phrases_in(document).items()}


Phrases = Annotated[
    dict[str, PhraseView],
    Field(default_factory=dict, description="sentences of this answer by text, for who says them in another language"),
]
Sha256 = Annotated[str, Field(json_schema_extra={"pattern": r"^[0-9a-f]{64}$"})]
Time = Annotated[float, PlainSerializer(iso_time, return_type=str)]


@dataclass(frozen=True)
class PassedOn:
    """Marks a body that is passed on unchanged and validated by another server, by this model. Here it is refused only
    if it cannot be sent as JSON again (not an object, NaN, half a character).
    """

    model: type[Body]

    def __get_pydantic_core_schema__(self, _source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_wrap_validator_function(_pass_on, handler.generate_schema(self.model))


def _pass_on(values: object, validate: Callable[[object], Any]) -> Json:
    try:
        json.dumps(values, allow_nan=False, ensure_ascii=False).encode()
    except (TypeError, ValueError, RecursionError):
        return dict(validate(values))
    return values if isinstance(values, dict) else dict(validate(values))
