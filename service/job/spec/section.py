"""What all tables of the job spec have in common. Lengths in mm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from service.job.spec.form import state_units

Length = Annotated[float, Field(gt=0, le=2000)]
Distance = Annotated[float, Field(gt=0, le=100_000)]
Radius = Annotated[float, Field(gt=0, le=25)]
StepDown = Annotated[float, Field(ge=0.01, le=50)]
Rate = Annotated[float, Field(gt=0, le=50_000)]
Speed = Annotated[float, Field(gt=0, le=200_000)]


class Section(BaseModel):
    """A table of the spec: exact types, finite numbers, no unknown keys, frozen."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, json_schema_extra=state_units
    )


@dataclass(frozen=True, slots=True)
class OneOf:
    """A text that is a key of a table, as a `Literal` of the keys would be: `Annotated[str, OneOf(...)]`.

    choices : what each key is to a person, in keywords of JSON schema (title, description, or others); where it is
              empty, the schema says no more than the key
    """

    choices: Mapping[str, Mapping[str, Any]]

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema(list(self.choices))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        choices = [{"const": key, **words} for key, words in self.choices.items()]
        return {**handler(schema), "oneOf": choices}
