"""What the person asked for as the JSON that the server reads. The server alone decides what is allowed."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from service.spec_files import spec_data


def spec_text(
    *, file: Path | None, preset: str | None, overrides: Sequence[str], light_picture: Path | None = None
) -> str | None:
    """JSON of file, preset, overrides and the picture of the light together; None where nothing was given.

    Not checked against this computer's profiles and versions: the mill may be one that only the server knows.
    """
    if file is None and preset is None and light_picture is None and not overrides:
        return None
    data = spec_data(file=file, preset=preset, overrides=overrides, light_picture=light_picture)
    return json.dumps(_plain(data), default=str)


def _plain(value: Any) -> Any:
    """TOML has numbers that JSON has not: they go as words, and the server names the key that holds them."""
    match value:
        case dict():
            return {str(key): _plain(below) for key, below in value.items()}
        case list() | tuple():
            return [_plain(below) for below in value]
        case float() if not math.isfinite(value):
            return str(value)
    return value
