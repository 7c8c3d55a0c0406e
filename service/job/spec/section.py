"""What all tables of the job spec have in common. Lengths in mm."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Length = Annotated[float, Field(gt=0, le=2000)]
Distance = Annotated[float, Field(gt=0, le=100_000)]


class Section(BaseModel):
    """A table of the spec: exact types, finite numbers, no unknown keys, frozen."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
