"""Common parts of all tables of the job spec, and how their keys look in the form for a new job. Lengths are in mm.

The words for the form go into the JSON schema, from which the page makes its rows (`service/page/new/fields.js`). Every
key of the spec has a row; `shown` describes it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypedDict, Unpack

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from phrases.phrase import Phrase

Length = Annotated[float, Field(ge=0.5, le=2000)]
Distance = Annotated[float, Field(ge=1, le=100_000)]
Radius = Annotated[float, Field(ge=0.01, le=25)]
StepDown = Annotated[float, Field(ge=0.01, le=50)]
Rate = Annotated[float, Field(ge=1, le=50_000)]
Speed = Annotated[float, Field(ge=1, le=200_000)]
_UNITS = (
    ("_mm_per_min", "mm/min"), ("_mm_per_s2", "mm/s²"), ("_rad_per_mm", "rad/mm"), ("_per_s", ""), ("_mm", "mm"),
    ("_um", "µm"), ("_nm", "nm"), ("_w", "W"), ("_rpm", "rpm"), ("_deg", "°"), ("_db", "dB"), ("_mb", "MB"),
    ("_s", "s"), ("hours", "h"), ("minutes", "min"),
)  # fmt: skip


class FieldLook(TypedDict, total=False):
    """How a row looks, if it differs from the others.

    card   : its card, "main" for the choices that everybody makes; left out: the part for experts, under the title of
             its table
    first  : before the others of its card
    usual  : in words, the value of a missing key without a default
    filled : the field shows the default
    start  : value of the field when the row appears
    when   : the row is shown only while each of these keys has this value, or one of these values
    names  : of the numbers of a list
    wide   : the row takes a whole line
    look   : choices with a description of each
    """

    card: Literal["main", "light", "mill", "picture"]
    first: bool
    usual: str
    filled: bool
    start: str
    when: dict[str, Any]
    names: tuple[str, ...]
    wide: bool
    look: Literal["cards"]


def shown(
    label: str, hint: str = "", *, choices: Mapping[Any, str | tuple[str, str]] | None = None, **look: Unpack[FieldLook]
) -> Any:
    """Return the metadata of a key: its label, a hint below it, and words for its values or for some of them.

    choices : by value: a word or two, or these and a sentence
    """
    form: dict[str, Any] = {**look}
    if choices is not None:
        rows = {value: (words, "") if isinstance(words, str) else words for value, words in choices.items()}
        form["choices"] = [{"const": value, "title": word, "description": s} for value, (word, s) in rows.items()]
    return Field(title=label, description=hint or None, json_schema_extra={"form": form})


def unit_of(key: str) -> str:
    """Return the unit in the name of a key; "" if it has none."""
    return next((unit for ending, unit in _UNITS if key.endswith(ending)), "")


def unknown_name(name: str, known: Iterable[str]) -> Phrase:
    """Return the sentence about an unknown name: all known ones."""
    names = ", ".join(f"'{one}'" for one in known)
    return Phrase("'{name}' is not known; allowed: {names}", name=name, names=names)


def state_units(schema: dict[str, Any]) -> None:
    """Add to the JSON schema of a table the unit of each of its keys that has one."""
    for key, entry in schema.get("properties", {}).items():
        if unit := unit_of(key):
            entry["unit"] = unit


class RuleError(ValueError):
    """A value that only our own validator refuses, and why.

    at : the key at fault below what was validated, for a rule about several keys of a table
    """

    def __init__(self, words: Phrase, *, at: str = "") -> None:
        super().__init__(words)
        self.words = words
        self.at = at


def none_or_from(least: float) -> AfterValidator:
    """Return the rule for a number that is 0 (none) or at least a minimum: a value in between is a mistake."""

    def check(value: float) -> float:
        if 0 < abs(value) < least:
            raise RuleError(
                Phrase("{value:g} is not allowed; allowed: 0, or at least {least:g}", value=value, least=least)
            )
        return value

    return AfterValidator(check)


class Section(BaseModel):
    """A table of the spec: exact types, finite numbers, no unknown keys, frozen."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, json_schema_extra=state_units
    )


@dataclass(frozen=True, slots=True)
class OneOf:
    """A text that is a key of a table, as a `Literal` of the keys would be: `Annotated[str, OneOf(...)]`.

    choices : a description of each key in keywords of JSON schema (title, description, or others); if it is empty, the
              schema has only the key
    """

    choices: Mapping[str, Mapping[str, Any]]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.choices))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        choices = [{"const": key, **words} for key, words in self.choices.items()]
        return {**handler(schema), "oneOf": choices}
