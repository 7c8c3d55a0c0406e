"""Lets programs on this computer find the agent of a mill: by its card, agent.json, and its token, both in its folder.

The card exists from when the agent listens until its orderly end. After a crash it may point to nothing, or to another
program, so a reader must ask that program for the machine's name. The token in the folder is valid for no other agent.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from phrases.phrase import Phrase
from service.errors import FailedError, InputError, sentence_of_os_error
from service.processes.files import keep_private, write_whole

CARD_FILE = "agent.json"
_ANY = {"0.0.0.0": "127.0.0.1", "::": "::1"}


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentCard:
    """url: for callers on this computer; token_file: where its token lies; started_s: seconds since 1970."""

    machine: str
    url: str
    pid: int
    token_file: str
    started_s: float
    version: str


def read_card(folder: Path) -> AgentCard | None:
    """Read the card in this folder; None if there is no readable one."""
    try:
        values: Any = json.loads((folder / CARD_FILE).read_text(encoding="utf-8"))
        card = AgentCard(**{name: values[name] for name in AgentCard.__slots__})
    except (OSError, ValueError, KeyError, TypeError):
        return None
    texts = (card.machine, card.url, card.token_file, card.version)
    return card if all(isinstance(text, str) for text in texts) and isinstance(card.pid, int) else None


@contextlib.contextmanager
def announce(folder: Path, *, machine: str, address: tuple[str, int], token_file: Path) -> Iterator[None]:
    """Keep the card in place during the `with` block. If the disk refuses, the server cannot find us, but the mill
    still works.
    """
    card = AgentCard(
        machine=machine,
        url=agent_url(*address),
        pid=os.getpid(),
        token_file=str(token_file.absolute()),
        started_s=round(time.time(), 3),
        version=metadata.version("causticmill"),
    )
    with contextlib.suppress(OSError):
        write_whole(folder / CARD_FILE, json.dumps(asdict(card)))
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            (folder / CARD_FILE).unlink(missing_ok=True)  # it is ours: we have held the folder all the time


def agent_url(host: str, port: int) -> str:
    """Return how a program on this computer reaches a server bound to `host`."""
    host = _ANY.get(host, host)
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


TOKEN_FILE = "token"
_SHORTEST = 16


def read_token(path: Path) -> str:
    """Read the token a person keeps in a file; InputError if it is missing or too short to be one."""
    try:
        others = path.stat().st_mode & 0o077
        token = path.read_text(encoding="ascii").strip()
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="--token-file: cannot read")) from None
    except UnicodeDecodeError:
        raise InputError(
            Phrase("--token-file: {path} is not plain text; allowed: one line of ASCII", path=path)
        ) from None
    if others:
        raise InputError(Phrase("--token-file: {path} can be read by others; run: chmod 600 {path}", path=path))
    if len(token) < _SHORTEST or not token.isprintable() or any(map(str.isspace, token)):
        raise InputError(
            Phrase("--token-file: {path} must hold one word of at least {least} characters", path=path, least=_SHORTEST)
        )
    return token


def make_token(folder: Path) -> tuple[str, Path]:
    """Return the token of this data folder, made on first use and readable by its owner only.

    If several agents start at once, all get the first one's token, because the file appears complete or not at all.
    """
    path = keep_private(folder) / TOKEN_FILE
    draft = path.with_name(f".{TOKEN_FILE}.{secrets.token_hex(4)}")
    try:
        if not path.exists():
            descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(descriptor, "w", encoding="ascii") as file:
                file.write(secrets.token_urlsafe(32) + "\n")
            try:
                with contextlib.suppress(FileExistsError):
                    os.link(draft, path)
            finally:
                draft.unlink()
    except OSError as error:
        raise FailedError(sentence_of_os_error(error, doing="cannot write the token")) from None
    return read_token(path), path
