"""Which server, and in whose name: options, then environment, then the token file of this user."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from machines.profile import user_folders
from service.errors import InputError, printable, sentence_of_os_error

DEFAULT_URL = "http://127.0.0.1:8000"
SERVER_VARIABLE = "CAUSTICMILL_SERVER"
TOKEN_VARIABLE = "CAUSTICMILL_TOKEN"
_LONGEST_TOKEN = 500


@dataclass(frozen=True, slots=True)
class Target:
    """A server's address without a slash at its end, and the token to show, if any."""

    url: str
    token: str | None


def target_of(*, server: str | None, token_file: Path | None, environment: Mapping[str, str] = os.environ) -> Target:
    """Return what was given, else the environment, else this computer and the token file, where there is one."""
    url = _address(server, "--server") if server else _address(environment.get(SERVER_VARIABLE, ""), SERVER_VARIABLE)
    if token_file is not None:
        return Target(url, _token(_read(token_file), f"--token-file {token_file}"))
    if text := environment.get(TOKEN_VARIABLE):
        return Target(url, _token(text, TOKEN_VARIABLE))
    for path in own_token_files(environment):
        if path.is_file():
            return Target(url, _token(_read(path), str(path)))
    return Target(url, None)


def own_token_files(environment: Mapping[str, str] = os.environ) -> tuple[Path, ...]:
    """Return where a person may keep the token: `token` beside the folder of the machine profiles."""
    return tuple(folder.parent / "token" for folder in user_folders(environment))


def _address(text: str, given_as: str) -> str:
    url = (text or DEFAULT_URL).rstrip("/")
    try:
        parts = urlsplit(url)
        usable = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port is None or parts.port > 0)
    except ValueError:
        usable = False
    if not usable or parts.query or parts.fragment or parts.username is not None:
        raise InputError(f"{given_as}: '{text}' is no address of a server; allowed: http://HOST:PORT or https://HOST")
    return url


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except UnicodeDecodeError:
        raise InputError(f"{path} holds no token") from None
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None


def _token(text: str, given_as: str) -> str:
    token = text.strip()
    if not token.isascii() or not token.isprintable() or " " in token or not 0 < len(token) <= _LONGEST_TOKEN:
        raise InputError(printable(f"{given_as}: this is no token; allowed: the one line that `token create` printed"))
    return token
