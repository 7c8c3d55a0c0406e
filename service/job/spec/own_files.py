"""Files of TOML in the person's configuration folder: where they are, how they are read and written."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from machines.profile import user_folders
from service.errors import InputError, sentence_of_os_error
from service.job.files import write_bytes

_MOST_BYTES = 1_000_000


def find_own_file(name: str) -> Path | None:
    """Return where the person's own file of that name is, or would be; None: there is no such folder."""
    folders = user_folders()
    return folders[0].parent / name if folders else None


def require_own_file(name: str) -> Path:
    """Return the same. InputError says how to have such a folder."""
    path = find_own_file(name)
    if path is None:
        raise InputError("no folder for files of one's own; set CAUSTICMILL_CONFIG_DIR and start the server again")
    return path


def write_own_file(path: Path, text: str) -> None:
    """Write it, whole or not at all, with the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())


def format_toml(values: Mapping[str, Any]) -> str:
    """Return numbers, flags, lists and printable texts as lines of TOML."""
    return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


def read_library(path: Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file of data. InputError names the file and says why it cannot be read."""
    try:
        with path.open("rb") as file:
            raw = file.read(_MOST_BYTES + 1)
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing=f"{path}: cannot be read")) from None
    if len(raw) > _MOST_BYTES:
        raise InputError(f"{path}: is too large; a {what} has at most {_MOST_BYTES} bytes")
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not valid TOML: {' '.join(str(error).split())}") from None
