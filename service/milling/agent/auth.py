"""Who may tell the mill what to do: a bearer token, and a Host header that no web page can make up."""

from __future__ import annotations

import contextlib
import hmac
import os
import secrets
from pathlib import Path

from starlette.types import ASGIApp, Receive, Scope, Send

from phrases.phrase import Phrase
from service.errors import FailedError, InputError, sentence_of_os_error
from service.http.admission import note_known
from service.http.hosts import is_own_host, own_names
from service.http.problems import Problem, problem_response
from service.processes.private import keep_private

TOKEN_FILE = "token"
_SHORTEST = 16
_OPEN = {"/livez"}


def read_token(path: Path) -> str:
    """Read the token a person keeps in a file; InputError where it is missing or too short to be one."""
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

    Of several agents that start at once all have the first one's: it is there as a whole or not at all.
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


class AgentGuard:
    """ASGI middleware: refuses foreign Host headers (403) and requests without the token (401)."""

    def __init__(self, app: ASGIApp, *, token: str, hosts: frozenset[str] = frozenset()) -> None:
        self._app = app
        self._token = token.encode()
        self._hosts = hosts | own_names()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and (problem := self._refusal(scope)) is not None:
            await problem_response(problem)(scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Problem | None:
        headers: dict[bytes, bytes] = {}
        for name, value in scope["headers"]:
            if name in (b"host", b"authorization") and name in headers:
                return Problem(400, f"two {name.decode()} headers")
            headers[name] = value
        host = headers.get(b"host", b"").decode("latin-1").lower()
        if not is_own_host(host, self._hosts):
            return Problem(403, f"Host is '{host}'; allowed: localhost, an address, or this machine's name")
        if scope["path"] in _OPEN:
            return None
        kind, _, token = headers.get(b"authorization", b"").partition(b" ")
        if kind.lower() != b"bearer" or not hmac.compare_digest(token.strip(), self._token):
            return Problem(401, "a token is needed: Authorization: Bearer ...", field="Authorization")
        note_known(scope)
        return None
