"""Who may stop a mill: known without asking anybody when the moment comes.

Whoever stands at the server's own computer; and every token with machine:run that was not revoked, even one that has
ended: a run of 40 hours outlives a page's token, and whom we let start it we let stop it. The tokens are held in
memory, from the file of the last server on, and renewed in the background, so that neither a busy database nor a full
pool keeps a stop from arriving.
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
    """For one event loop. file: where those who may stop are kept for a server that has no database yet."""

    def __init__(self, tokens: TokenBook, file: Path) -> None:
        self._tokens = tokens
        self._file = file
        self._written = read_stoppers(file)
        self._stoppers = dict(self._written)  # by the hash of the secret
        self._known = set(self._stoppers)  # hashes of all tokens that were not revoked
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="stop-access")

    def find(self, secret: str) -> Stopper | None:
        """Find whose token this is, if it may stop mills, from memory."""
        return self._stoppers.get(hash_secret(secret)) if secret else None

    def knows(self, secret: str) -> bool:
        """Return whether this was a valid token when the tokens were last read."""
        return bool(secret) and hash_secret(secret) in self._known

    def remember(self, secret: str, token: Token) -> None:
        """Remember one that has just been found to be good."""
        self._known.add(hash_secret(secret))
        if TokenScope.MACHINE_RUN in token.scopes:
            self._stoppers[hash_secret(secret)] = Stopper(token.id, token.name)

    async def keep_fresh(self) -> None:
        """Take over what was made and revoked, until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self._known, self._stoppers = await loop.run_in_executor(self._thread, self._look)
            except SQLAlchemyError as error:  # those known stay known
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
