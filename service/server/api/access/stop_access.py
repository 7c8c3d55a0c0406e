"""Decides who may stop a mill, from memory, so that a stop waits for nothing.

Anyone at the server's own computer may, and every token with machine:run that was not revoked. An expired token may
too: a run of 40 hours outlives a page's token, and a person who was allowed to start it may stop it. The tokens are
kept in memory, read at the start from the file of the last server, and renewed in the background, so that neither a
busy database nor a full pool delays a stop.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service.errors import printable
from service.server.database.tokens import Token, TokenBook, TokenScope
from service.server.stoppers import Stopper, hash_secret, read_stoppers, write_stoppers

_RENEW_S = 5.0
_log = structlog.get_logger("api")


class StopAccess:
    """For one event loop. file: keeps the list of those who may stop, for a server whose database is not ready yet."""

    def __init__(self, tokens: TokenBook, file: Path) -> None:
        self._tokens = tokens
        self._file = file
        self._written = read_stoppers(file)
        self._stoppers = dict(self._written)  # by the hash of the secret
        self._known = set(self._stoppers)  # hashes of all tokens that were not revoked
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="stop-access")

    def find(self, secret: str) -> Stopper | None:
        """Return the owner of this token if it may stop mills."""
        return self._stoppers.get(hash_secret(secret)) if secret else None

    def knows(self, secret: str) -> bool:
        """Return whether this was a valid token when the tokens were last read."""
        return bool(secret) and hash_secret(secret) in self._known

    def remember(self, secret: str, token: Token) -> None:
        """Remember a token that has just been found valid."""
        self._known.add(hash_secret(secret))
        if TokenScope.MACHINE_RUN in token.scopes:
            self._stoppers[hash_secret(secret)] = Stopper(token.id, token.name)

    async def keep_fresh(self) -> None:
        """Follow new and revoked tokens until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self._known, self._stoppers = await loop.run_in_executor(self._thread, self._look)
            except SQLAlchemyError as error:  # the known tokens stay valid
                _log.warning("tokens were not looked at", error=printable(str(error))[:200])
            await asyncio.sleep(_RENEW_S)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _look(self) -> tuple[set[str], dict[str, Stopper]]:
        found = self._tokens.find_unrevoked()
        may_stop = {digest: token for digest, token in found.items() if TokenScope.MACHINE_RUN in token.scopes}
        stoppers = {digest: Stopper(token.id, token.name) for digest, token in may_stop.items()}
        if stoppers != self._written:
            try:
                write_stoppers(self._file, stoppers)
                self._written = dict(stoppers)
            except OSError as error:
                _log.warning("who may stop mills was not written", error=printable(str(error))[:200])
        return set(found), stoppers
