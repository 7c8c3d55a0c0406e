"""One mill's agent over HTTP: where it is, that it is the right one, and what can go wrong on the way to it.

Nothing is ever sent twice by itself, except a hold or an abort of which no answer came.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import httpx

from service.agent.auth import read_token
from service.agent.card import read_card
from service.errors import InputError
from service.fleet.machines import KnownMachine
from service.web.problems import Problem

ASK_S = 3.0
TELL_S = 30.0  # a start asks the controller first
_CONNECT_S = 2.0
_QUIET_S = 60.0  # an event stream beats every 15 s

Json = dict[str, Any]


class AgentAwayError(Exception):
    """The agent did not answer. `sent`: the request may have arrived all the same."""

    def __init__(self, words: str, *, sent: bool = False) -> None:
        super().__init__(words)
        self.words = words
        self.sent = sent

    def problem(self) -> Problem:
        return Problem(503, self.words, field="machine", headers={"Retry-After": "2"})


class AgentLink:
    """Speaks to the agent of one machine; finds it again when it was started anew."""

    def __init__(self, machine: KnownMachine, client: Callable[[], httpx.AsyncClient]) -> None:
        self.machine = machine
        self._client = client
        self._address: tuple[str, str] | None = None  # where the right agent was met last, and its token
        self._finding = asyncio.Lock()

    async def get(self, path: str, *, timeout_s: float = ASK_S) -> Json:
        return await self._told("GET", path, timeout_s=timeout_s)

    async def post(self, path: str, body: Json | None = None, *, timeout_s: float = TELL_S) -> Json:
        return await self._told("POST", path, timeout_s=timeout_s, json=body or {})

    async def urgent(self, path: str) -> Json:
        """A hold or an abort: to do it twice is better than not at all, so one that failed is sent once more."""
        try:
            return await self.post(path)
        except AgentAwayError:
            return await self.post(path)

    async def put(self, path: str, content: AsyncIterator[bytes], size: int) -> Json:
        headers = {"Content-Length": str(size)}
        return await self._told("PUT", path, timeout_s=TELL_S, content=content, headers=headers)

    @asynccontextmanager
    async def events(self, last_id: str) -> AsyncIterator[AsyncIterator[str]]:
        """The lines of the agent's event stream."""
        url, token = await self.address()
        headers = {"Authorization": f"Bearer {token}"} | ({"Last-Event-ID": last_id} if last_id else {})
        timeout = httpx.Timeout(_QUIET_S, connect=_CONNECT_S)
        try:
            async with self._client().stream("GET", f"{url}/v1/events", headers=headers, timeout=timeout) as answer:
                if answer.status_code != 200:
                    await answer.aread()
                    raise self._refusal(answer)
                yield answer.aiter_lines()
        except httpx.HTTPError as error:
            self._address = None
            raise AgentAwayError(self._words(error)) from None

    async def address(self) -> tuple[str, str]:
        """Address and token of the agent, once it has said that it is this machine's. AgentAwayError."""
        if self._address is None:
            async with self._finding:
                if self._address is None:
                    self._address = await self._found()
        return self._address

    # ------------------------------------------------------------------

    async def _found(self) -> tuple[str, str]:
        last: AgentAwayError | None = None
        for url, token_file in self._candidates():
            try:
                token = read_token(token_file)
            except InputError as error:
                last = AgentAwayError(f"machine '{self.machine.name}': its agent's token cannot be used: {error}")
                continue
            try:
                await self._require_right(url, token)
            except AgentAwayError as away:
                last = away
                continue
            return url, token
        raise last or AgentAwayError(f"machine '{self.machine.name}' has no agent at present; `serve` starts one")

    def _candidates(self) -> list[tuple[str, Path]]:
        if self.machine.remote and self.machine.token_file is not None:
            return [(self.machine.url, self.machine.token_file)]
        cards = [card for folder in self.machine.folders if (card := read_card(folder)) is not None]
        return [(card.url, Path(card.token_file)) for card in cards]

    async def _require_right(self, url: str, token: str) -> None:
        """Who answers there? After a crash a card points to nobody, or to somebody else."""
        try:
            answer = await self._client().get(
                f"{url}/v1/machine", headers={"Authorization": f"Bearer {token}"}, timeout=_timeout(ASK_S)
            )
            said = answer.json().get("name") if answer.status_code == 200 else None
        except (httpx.HTTPError, ValueError, AttributeError) as error:
            raise AgentAwayError(self._words(error)) from None
        if answer.status_code in (401, 403):
            raise AgentAwayError(
                f"machine '{self.machine.name}': the agent at {url} does not take the token we have for it"
            )
        if said != self.machine.name:
            raise AgentAwayError(
                f"machine '{self.machine.name}': at {url} there is {f'{said!r}' if said else 'no agent'}"
            )

    async def _told(self, method: str, path: str, *, timeout_s: float, **more: Any) -> Json:
        """One that certainly did not arrive goes to the agent's new place, if it has moved; no other is sent again."""
        before = self._address
        try:
            return await self._asked(method, path, timeout_s=timeout_s, **more)
        except AgentAwayError as away:
            if away.sent or before is None or "content" in more:
                raise
            return await self._asked(method, path, timeout_s=timeout_s, **more)

    async def _asked(self, method: str, path: str, *, timeout_s: float, headers: Any = None, **more: Any) -> Json:
        url, token = await self.address()
        headers = {"Authorization": f"Bearer {token}"} | (headers or {})
        try:
            answer = await self._client().request(
                method, url + path, headers=headers, timeout=_timeout(timeout_s), **more
            )
        except httpx.HTTPError as error:
            self._address = None
            unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout)
            raise AgentAwayError(self._words(error), sent=not unsent) from None
        if answer.is_success:
            return self._json(answer)
        if answer.status_code in (401, 403):
            self._address = None
        raise self._refusal(answer)

    def _json(self, answer: httpx.Response) -> Json:
        try:
            values = answer.json() if answer.content else {}
        except ValueError:
            values = None
        if not isinstance(values, dict):
            raise Problem(502, f"the agent of '{self.machine.name}' answered with something that is not JSON")
        return values

    def _refusal(self, answer: httpx.Response) -> Problem:
        """The agent's own refusal, passed on; what is between it and us only is not the caller's fault."""
        try:
            told = answer.json()
        except ValueError:
            told = {}
        detail = str(told.get("detail", "")) if isinstance(told, dict) else ""
        field = str(told.get("field", "")) if isinstance(told, dict) else ""
        status = answer.status_code
        if status in (401, 403):
            return Problem(502, f"the agent of '{self.machine.name}' does not take the token we have for it")
        if not detail or status not in (404, 409, 413, 422, 503, 507):
            return Problem(502, f"the agent of '{self.machine.name}' answered {status}: {detail or 'no reason given'}")
        return Problem(status, detail, field=field)

    def _words(self, error: Exception) -> str:
        reason = str(error) or type(error).__name__
        return f"the agent of '{self.machine.name}' cannot be reached: {reason}"


def _timeout(timeout_s: float) -> httpx.Timeout:
    return httpx.Timeout(timeout_s, connect=_CONNECT_S)
