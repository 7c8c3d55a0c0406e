"""HTTP client of the mills' agents: lists them, finds each, checks that it is the right one, and sends requests.

It uses no database. Nothing is ever sent twice automatically, except a stop without an answer. Answers are bounded in
size and time, and redirects of an agent are not followed.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote

import httpx

from machines.mill.orders import STOP_S
from phrases.phrase import Phrase, restore
from service.errors import InputError
from service.http.problems import BY, CONTROL, FROM, GRANT, Problem, ServerCode
from service.milling.agent.card import read_card, read_token
from service.server.fleet.agent_feed import AgentFeed
from service.server.fleet.agent_replies import (
    AgentAwayError,
    cut_text,
    json_object,
    list_values,
    parse_holder,
    phrases_of,
    read_lines,
    read_whole,
    table,
)
from service.server.fleet.registry import KnownMachine, read_machines
from service.settings import ServerSettings

ASK_S = 3.0
SEND_S = 30.0
_STOP_TRY_S = STOP_S + 0.5  # the agent's own time, and the round trip
URGENT_S = 2 * _STOP_TRY_S  # for a stop: a person waits beside the mill
_CONNECT_S = 2.0
_QUIET_S = 60.0  # an event stream beats every 15 s

_HTTP_ERRORS = (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError)

Json = dict[str, Any]
T = TypeVar("T")


class AgentLink:
    """Talks to the agent of one machine; finds it again after a restart."""

    def __init__(self, machine: KnownMachine, client: Callable[[], httpx.AsyncClient]) -> None:
        self.machine = machine
        self._client = client
        self._address: tuple[str, str] | None = None  # where the right agent is, and its token
        self._last_address: tuple[str, str] | None = None  # its last known address: good enough for a stop
        self._finding = asyncio.Lock()
        self.feed = AgentFeed(self.open_events, AgentAwayError)

    async def get(self, path: str, *, timeout_s: float = ASK_S) -> Json:
        return await self._send("GET", path, timeout_s=timeout_s)

    async def post(self, path: str, body: Json | None = None, *, timeout_s: float = SEND_S) -> Json:
        return await self._send("POST", path, timeout_s=timeout_s, json=body or {})

    async def send_once(self, path: str, body: Json, *, timeout_s: float, headers: Json | None = None) -> Json:
        """Send like `post`, but never repeat it, even if it certainly did not arrive: an order is for now or never."""
        return await self._request("POST", path, timeout_s=timeout_s, json=body, headers=headers)

    async def delete(self, path: str, *, headers: Json) -> Json:
        return await self._request("DELETE", path, timeout_s=ASK_S, headers=headers)

    async def send_urgent(self, path: str, *, headers: Json | None = None) -> Json:
        """Send a stop. Arriving twice is better than not at all, so a stop that failed is sent once more.

        It goes to the agent's last known address before anything is looked up; no other program accepts our token.
        Within URGENT_S it is known whether it was accepted; if not, a person has to use the mill's own button.
        """
        try:
            async with asyncio.timeout(URGENT_S):
                if self._last_address is not None:
                    with contextlib.suppress(AgentAwayError):
                        return await self._stop_at(self._last_address, path, headers)
                self._address = self._last_address = await self._find()
                return await self._stop_at(self._address, path, headers)
        except TimeoutError:
            words = f"the agent of '{self.machine.name}' did not answer within {URGENT_S:g} s"
            raise AgentAwayError(words, ServerCode.AGENT_UNREACHED, {"seconds": URGENT_S}, sent=True) from None

    async def _stop_at(self, address: tuple[str, str], path: str, headers: Json | None) -> Json:
        return await self._ask_at(address, "POST", path, timeout_s=_STOP_TRY_S, json={}, headers=headers)

    async def put(self, path: str, content: AsyncIterator[bytes], size: int) -> Json:
        headers = {"Content-Length": str(size)}
        return await self._send("PUT", path, timeout_s=SEND_S, content=content, headers=headers)

    @asynccontextmanager
    async def open_events(self, last_id: str) -> AsyncIterator[AsyncIterator[str]]:
        """Open the lines of the agent's event stream."""
        url, token = await self.find_address()
        headers = {"Authorization": f"Bearer {token}"} | ({"Last-Event-ID": last_id} if last_id else {})
        timeout = httpx.Timeout(_QUIET_S, connect=_CONNECT_S)
        try:
            async with self._client().stream("GET", f"{url}/v1/events", headers=headers, timeout=timeout) as answer:
                if answer.status_code != 200:
                    raise self._refusal(answer.status_code, await read_whole(answer, self.machine.name))
                yield read_lines(answer, self.machine.name)
        except _HTTP_ERRORS as error:
            self._address = None
            raise self._make_unreached(error) from None

    async def find_address(self) -> tuple[str, str]:
        """Return the address and token of the agent, once it has said that it is this machine's. AgentAwayError."""
        if self._address is None:
            async with self._finding:
                if self._address is None:
                    self._address = self._last_address = await self._find()
        return self._address

    # ------------------------------------------------------------------

    async def _find(self) -> tuple[str, str]:
        last: AgentAwayError | None = None
        for url, token_file in self._candidates():
            try:
                token = read_token(token_file)
            except InputError as error:
                words = f"machine '{self.machine.name}': its agent's token cannot be used: {error}"
                last = AgentAwayError(words, ServerCode.AGENT_KEY_UNUSABLE, {"reason": str(error)})
                continue
            try:
                await self._require_right(url, token)
            except AgentAwayError as away:
                last = away
                continue
            return url, token
        raise last or AgentAwayError(
            f"machine '{self.machine.name}' has no agent at present; `serve` starts one", ServerCode.AGENT_ABSENT
        )

    def _candidates(self) -> list[tuple[str, Path]]:
        if self.machine.remote and self.machine.token_file is not None:
            return [(self.machine.url, self.machine.token_file)]
        cards = [card for folder in self.machine.folders if (card := read_card(folder)) is not None]
        return [(card.url, Path(card.token_file)) for card in cards]

    async def _require_right(self, url: str, token: str) -> None:
        """Raise if another agent answers: after a crash a card may point to nothing, or to another program."""
        try:
            status, content = await self._exchange("GET", f"{url}/v1/machine", token, within_s=ASK_S)
            said = json_object(content, self.machine.name).get("name") if status == 200 else None
        except (*_HTTP_ERRORS, TimeoutError, Problem) as error:
            raise self._make_unreached(error) from None
        if status in (401, 403):
            raise AgentAwayError(
                f"machine '{self.machine.name}': the agent at {url} does not take the token we have for it",
                ServerCode.AGENT_KEY_REFUSED,
            )
        if said != self.machine.name:
            there = repr(said[:80]) if isinstance(said, str) and said else "no agent"
            raise AgentAwayError(f"machine '{self.machine.name}': at {url} there is {there}", ServerCode.AGENT_OTHER)

    async def _send(self, method: str, path: str, *, timeout_s: float, **more: Any) -> Json:
        """Send a request. If it certainly did not arrive, send it to the agent's new address, if that has changed;
        never repeat any other.
        """
        before = self._address
        try:
            return await self._request(method, path, timeout_s=timeout_s, **more)
        except AgentAwayError as away:
            if away.sent or before is None or "content" in more:
                raise
            return await self._request(method, path, timeout_s=timeout_s, **more)

    async def _request(self, method: str, path: str, *, timeout_s: float, **more: Any) -> Json:
        return await self._ask_at(await self.find_address(), method, path, timeout_s=timeout_s, **more)

    async def _ask_at(self, address: tuple[str, str], method: str, path: str, *, timeout_s: float, **more: Any) -> Json:
        url, token = address
        try:
            status, content = await self._exchange(method, url + path, token, within_s=timeout_s, **more)
        except (*_HTTP_ERRORS, TimeoutError) as error:
            self._address = None
            unsent = isinstance(error, httpx.ConnectError | httpx.ConnectTimeout | httpx.PoolTimeout)
            raise self._make_unreached(error, sent=not unsent) from None
        if 200 <= status < 300:
            return json_object(content, self.machine.name)
        if status in (401, 403):
            self._address = None
        raise self._refusal(status, content)

    async def _exchange(
        self, method: str, url: str, token: str, *, within_s: float, headers: Json | None = None, **more: Any
    ) -> tuple[int, bytes]:
        """Return status and content of one answer. The time is for all of it, but a program takes as long as it
        takes.
        """
        own = {"Authorization": f"Bearer {token}", "Accept-Encoding": "identity"} | (headers or {})
        timeout = httpx.Timeout(within_s, connect=_CONNECT_S)
        async with asyncio.timeout(None if "content" in more else within_s + _CONNECT_S):
            async with self._client().stream(method, url, headers=own, timeout=timeout, **more) as answer:
                return answer.status_code, await read_whole(answer, self.machine.name)

    def _refusal(self, status: int, content: bytes) -> Problem:
        """Return the agent's own refusal; problems on the way to the agent are not the caller's fault."""
        try:
            said = json_object(content, self.machine.name)
        except Problem:
            said = {}
        body: Json = restore(said, phrases_of(said) or {})
        detail, field = cut_text(body.get("detail", "")), str(body.get("field", ""))[:200]
        if status in (401, 403):
            words = f"the agent of '{self.machine.name}' does not take the token we have for it"
            return Problem(502, words, code=ServerCode.AGENT_KEY_REFUSED)
        if not detail or status not in (404, 409, 413, 422, 428, 503, 507):
            reason = detail or Phrase("no reason given")
            words, values = f"the agent of '{self.machine.name}' answered {status}: {reason}", {"status": status}
            return Problem(502, words, code=ServerCode.AGENT_FAULT, values=values | {"reason": reason})
        more: Json = {"effect": cut_text(body["effect"])} if isinstance(body.get("effect"), str) else {}
        if "control" in body:
            more["control"] = parse_holder(table(body, "control")).model_dump(mode="json") if body["control"] else None
        code = body["code"][:100] if isinstance(body.get("code"), str) else ""
        return Problem(status, detail, field=field, code=code, values=list_values(body), more=more)

    def _make_unreached(self, error: Exception, *, sent: bool = False) -> AgentAwayError:
        reason = str(error) or {"ReadTimeout": "no answer in time", "TimeoutError": "no answer in time"}.get(
            type(error).__name__, type(error).__name__
        )
        words = f"the agent of '{self.machine.name}' cannot be reached: {reason}"
        return AgentAwayError(words, ServerCode.AGENT_UNREACHED, {"reason": reason}, sent=sent)


AT_THE_SERVER = "somebody at the server's computer"  # a caller there without a token


@dataclass(frozen=True, slots=True, kw_only=True)
class OrderContext:
    """The context of an order: who gives it, from where, and on which control and grant. arrived_s: by
    `suspend_aware_clock_s`.
    """

    name: str
    origin: str
    control: str = ""
    grant: str = ""
    arrived_s: float = 0.0

    def headers(self) -> dict[str, str]:
        values = {BY: quote(self.name), FROM: quote(self.origin), CONTROL: self.control, GRANT: self.grant}
        return {name: value for name, value in values.items() if value}


def no_machine(name: str, known: Iterable[str]) -> Problem:
    words = ", ".join(known) or "none; a profile of yours with [link] port makes one"
    return Problem(404, Phrase("no machine '{name}'; known: {known}", name=name, known=words), field="machine")


class AgentLinks:
    """For one event loop."""

    def __init__(self, settings: ServerSettings) -> None:
        self.settings = settings
        self.links: dict[str, AgentLink] = {}
        self.stopped_s: dict[str, float] = {}  # time of the last stop of a machine, by `suspend_aware_clock_s`
        self._http: httpx.AsyncClient | None = None
        self._looking = ThreadPoolExecutor(1, thread_name_prefix="profiles")

    async def list_machines(self) -> tuple[dict[str, KnownMachine], list[str]]:
        """Return the machines by name, and the fault of their list."""
        return await asyncio.get_running_loop().run_in_executor(self._looking, read_machines, self.settings)

    async def find_machine(self, name: str) -> KnownMachine:
        """Return the machine; Problem 404 if there is none of this name."""
        known, _ = await self.list_machines()
        if name not in known:
            raise no_machine(name, known)
        return known[name]

    def get_link(self, machine: KnownMachine) -> AgentLink:
        """Return the link to its agent; a new one if the machine has changed."""
        found = self.links.get(machine.name)
        if found is None or found.machine != machine:
            found = self.links[machine.name] = AgentLink(machine, self.get_http_client)
        return found

    def get_known_link(self, machine: str) -> AgentLink | None:
        """Return the link used before, without a look at any file."""
        return self.links.get(machine)

    async def renew_link(self, machine: str) -> AgentLink:
        """Return the link by the present profiles, read in a thread that nothing else uses. Problem 404."""
        known, _ = await asyncio.get_running_loop().run_in_executor(self._looking, read_machines, self.settings)
        if machine not in known:
            raise no_machine(machine, known)
        return self.get_link(known[machine])

    async def meet_agents(self) -> None:
        """Find the address of every mill's agent before the first order or stop. Skip an agent that is away."""
        known, _ = await self.list_machines()
        met = (self.get_link(machine).find_address() for machine in known.values())
        await asyncio.gather(*met, return_exceptions=True)

    async def close(self) -> None:
        if self._http is not None:
            await self._http.aclose()
            self._http = None
        self._looking.shutdown(wait=False, cancel_futures=True)

    def get_http_client(self) -> httpx.AsyncClient:
        """Return one client for all agents and cameras, made in the loop that uses it. No proxies: all are near."""
        if self._http is None:
            limits = httpx.Limits(max_connections=None, max_keepalive_connections=20, keepalive_expiry=30)
            self._http = httpx.AsyncClient(trust_env=False, limits=limits, headers={"User-Agent": "causticmill"})
        return self._http
