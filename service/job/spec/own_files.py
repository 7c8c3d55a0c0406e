"""TOML files in the person's configuration folder: their paths, reading and writing; also the mills that a person
describes on the page or over REST. Profiles written by hand are never changed.
"""

from __future__ import annotations

import contextlib
import json
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from machines.profile import MachineProfile, ProfileError, find_own_profiles, load_profile, profile_names, user_folders
from machines.profile_values import UnreadableFileError, read_data
from phrases.phrase import Phrase
from service.errors import InputError
from service.job.files import write_bytes

PROFILE_KEYS = (
    "extends", "description", "travel_mm", "max_rate_mm_per_min", "acceleration_mm_per_s2", "spindle_rpm", "step_mm",
    "z_noise_mm", "collet_mm", "spindle_w", "removal_cm3_per_min",
)  # fmt: skip
"""Keys of a profile's file that the page or REST can state. A file with other keys was written by hand."""


def find_own_file(name: str) -> Path | None:
    """Return the path of the person's own file of that name, existing or not; None without a configuration folder."""
    folders = user_folders()
    return folders[0].parent / name if folders else None


def require_own_file(name: str) -> Path:
    """Return the path of `find_own_file`. InputError says how to get a configuration folder."""
    path = find_own_file(name)
    if path is None:
        raise InputError(Phrase("no folder for your own files; set CAUSTICMILL_CONFIG_DIR and start the server again"))
    return path


def write_own_file(path: Path, text: str) -> None:
    """Write the file, completely or not at all, and create the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())


def format_toml(values: Mapping[str, Any]) -> str:
    """Return numbers, flags, lists and printable texts as lines of TOML."""
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


def read_library(path: Path) -> dict[str, Any]:
    """Return the tables of a TOML file of data. InputError names the file and the reason if it cannot be read."""
    try:
        return read_data(path)
    except UnreadableFileError as error:
        raise InputError(Phrase("{path}: {cause}", path=path, cause=error.words)) from None


def save_profile(name: str, values: Mapping[str, Any]) -> MachineProfile:
    """Write a profile, completely or not at all, and return it.

    values : by PROFILE_KEYS; `extends` is a built-in profile
    InputError names the unusable value, or says that the name belongs to a built-in profile or a file written by hand.
    """
    file = _require_free(name)
    if values.get("extends") not in (built_in := profile_names(())):
        words = Phrase(
            "{key} = {value}: allowed: {allowed}",
            key="extends",
            value=repr(values.get("extends")),
            allowed=", ".join(built_in),
        )
        raise InputError(words, field="extends")
    text = format_toml(values)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / file.name).write_text(text, "utf-8")
        try:
            profile = load_profile(name, (Path(folder),))
        except ProfileError as error:
            raise InputError(error.text, field=error.key) from None
    write_own_file(file, text)
    return profile


def forget_profile(name: str) -> None:
    """Delete a saved profile; jobs keep their figures. InputError as for `save_profile`."""
    _require_free(name).unlink(missing_ok=True)


def read_stated_profiles() -> dict[str, dict[str, Any]]:
    """Return the values of each profile saved by `save_profile`, by name."""
    read = {name: _parse_statement(Path(file)) for name, file in find_own_profiles().items()}
    return {name: values for name, values in read.items() if values is not None}


def _require_free(name: str) -> Path:
    if name in profile_names(()):
        raise InputError(Phrase("'{name}' is a built-in profile; choose another name", name=name), field="profile")
    file = require_own_file(f"machines/{name}.toml")
    if file.exists() and _parse_statement(file) is None:
        words = Phrase(
            "the profile '{name}' was written by hand; change it in its file, {file}", name=name, file=f"{name}.toml"
        )
        raise InputError(words, field="profile")
    return file


def _parse_statement(file: Path) -> dict[str, Any] | None:
    """Return the values of a file written by `save_profile`."""
    with contextlib.suppress(OSError, ValueError):
        text = file.read_text("utf-8")
        values = tomllib.loads(text)
        if values.keys() <= set(PROFILE_KEYS) and format_toml(values) == text:
            return values
    return None
