"""What all tables of the job spec have in common. Lengths in mm."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

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
