"""Mills that a person states on the page or over REST: profiles beside those written by hand, which are left alone."""

from __future__ import annotations

import contextlib
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from machines.profile import MachineProfile, ProfileError, find_own_profiles, load_profile, profile_names
from service.errors import InputError
from service.job.spec.own_files import format_toml, require_own_file, write_own_file

KEYS = (
    "extends", "description", "travel_mm", "max_rate_mm_per_min", "acceleration_mm_per_s2", "spindle_rpm", "step_mm",
    "z_noise_mm", "collet_mm", "spindle_w", "removal_cm3_per_min",
)  # fmt: skip
"""Of a profile's file, which can be stated so. A file with other keys was written by hand."""


def save_profile(name: str, values: Mapping[str, Any]) -> MachineProfile:
    """Write a profile, whole or not at all, and return it.

    values : by KEYS; `extends` is a built-in profile
    InputError says which value cannot be, or that the name is not free: a built-in's, or a file's written by hand.
    """
    file = _require_free(name)
    if values.get("extends") not in (built_in := profile_names(())):
        raise InputError(f"extends = {values.get('extends')!r}: allowed: {', '.join(built_in)}")
    text = format_toml(values)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / file.name).write_text(text, "utf-8")
        try:
            profile = load_profile(name, (Path(folder),))
        except ProfileError as error:
            raise InputError(error.text) from None
    write_own_file(file, text)
    return profile


def forget_profile(name: str) -> None:
    """Delete it; jobs keep the figures that they were made with. InputError as above."""
    _require_free(name).unlink(missing_ok=True)


def read_stated_profiles() -> dict[str, dict[str, Any]]:
    """Return the values of each profile that was stated so, by name."""
    read = {name: _parse_statement(Path(file)) for name, file in find_own_profiles().items()}
    return {name: values for name, values in read.items() if values is not None}


def _require_free(name: str) -> Path:
    if name in profile_names(()):
        raise InputError(f"'{name}' is a built-in profile; allowed: a name of its own")
    file = require_own_file(f"machines/{name}.toml")
    if file.exists() and _parse_statement(file) is None:
        raise InputError(f"the profile '{name}' was written by hand; change it in its file, {name}.toml")
    return file


def _parse_statement(file: Path) -> dict[str, Any] | None:
    """Return the values of a file that is as `save_profile` writes it."""
    with contextlib.suppress(OSError, ValueError):
        text = file.read_text("utf-8")
        values = tomllib.loads(text)
        if values.keys() <= set(KEYS) and format_toml(values) == text:
            return values
    return None
