"""What the form of a new job shows of a key of the spec: it goes into the JSON schema, from which the page makes its
rows (`service/page/new/fields.js`). A key has a row as soon as it is in the spec; these are the words for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypedDict, Unpack

from pydantic import Field

_UNITS = (
    ("_mm_per_min", "mm/min"), ("_mm_per_s2", "mm/s²"), ("_rad_per_mm", "rad/mm"), ("_per_s", ""), ("_mm", "mm"),
    ("_um", "µm"), ("_rpm", "rpm"), ("_deg", "°"), ("_db", "dB"), ("_mb", "MB"), ("_s", "s"), ("hours", "h"),
    ("minutes", "min"),
)  # fmt: skip


class FieldLook(TypedDict, total=False):
    """How a row looks, where it is not like all others.

    card   : the card that it stands on, "main" for what everybody chooses; left out: in the part for experts, under the
             title of its table
    first  : before the others of its card
    usual  : in words, what counts where the key is left out and has no default
    filled : the default stands in the field
    start  : what the field holds when the row appears
    when   : the row is there only while each of these keys has this value, or one of these
    names  : of the numbers of a list
    wide   : it has a line of its own
    look   : choices with words about each
    """

    card: Literal["main", "lens", "light", "mill", "picture"]
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

    choices : by value, a word or two, or those and a sentence
    """
    form: dict[str, Any] = {**look}
    if choices is not None:
        told = {value: (words, "") if isinstance(words, str) else words for value, words in choices.items()}
        form["choices"] = [{"const": value, "title": word, "description": s} for value, (word, s) in told.items()]
    return Field(title=label, description=hint or None, json_schema_extra={"form": form})


def unit_of(key: str) -> str:
    """Return the unit that the name of a key states, "" where it states none."""
    return next((unit for ending, unit in _UNITS if key.endswith(ending)), "")


def state_units(schema: dict[str, Any]) -> None:
    """Add to the JSON schema of a table the unit of each of its keys that has one."""
    for key, told in schema.get("properties", {}).items():
        if unit := unit_of(key):
            told["unit"] = unit
