"""Who may stop a mill: known without asking anybody when the moment comes.

Whoever stands at the server's own computer; and every token with machine:run that was not revoked, even one that has
ended: a run of 40 hours outlives a page's token, and whom we let start it we let stop it. The tokens are held in
memory and renewed in the background, so that neither a busy database nor a full pool keeps a stop from arriving.
"""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor

import structlog
from sqlalchemy.exc import SQLAlchemyError

from service.errors import printable
from service.server.database.tokens import Token, TokenBook, TokenScope, hash_secret

_RENEW_S = 5.0
_log = structlog.get_logger("api")


class StopAccess:
    """For one event loop."""

    def __init__(self, tokens: TokenBook) -> None:
        self._tokens = tokens
        self._known: dict[str, Token] = {}  # by the hash of the secret
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="stop-access")

    def find(self, secret: str) -> Token | None:
        """Find the token that may stop mills, from memory."""
        return self._known.get(hash_secret(secret)) if secret else None

    def remember(self, digest: str, token: Token) -> None:
        """Remember one that has just been found to be good."""
        if TokenScope.MACHINE_RUN in token.scopes:
            self._known[digest] = token

    async def keep_fresh(self) -> None:
        """Take over what was made and revoked, until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                self._known = await loop.run_in_executor(self._thread, self._tokens.find_stoppers)
            except SQLAlchemyError as error:  # those known stay known
                _log.warning("tokens were not looked at", error=printable(str(error))[:200])
            await asyncio.sleep(_RENEW_S)

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)
