"""HOLD from the press to `!` on the wire, with all that may be busy, full, away or expired: one run, one program.

Pressed is at the job server, each time on a new connection; over the WebSocket that is kept for stops; and beside them
at the agent itself, as before there was a server between. The time begins before the client connects or sends, and ends
where the mill's end of the wire has read the `!`. One that does not come counts as ten seconds.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
from playwright.sync_api import Browser, Page

from tests.benchmarks.server.rows import percentile
from tests.benchmarks.server.sizes import SHARE
from tests.benchmarks.stops import conditions
from tests.benchmarks.stops.pressing import PATIENCE_S, BySocket, Press, Presser, Presses, by_agent, by_server
from tests.benchmarks.timing import Figure
from tests.disturbances.disk import SlowDisk, missing_for_slow, slow_disk
from tests.disturbances.floor import MILL, Floor, running_floor
from tests.page.browser import missing, running_browser

_LINES = 6000  # seven minutes of the mill's time
_SHORT_S = 18.0 * SHARE
_LONG_S = 30.0 * SHARE
_STALL_S = 26.0 * SHARE  # a journal that is not safe after 30 s holds the run by itself
_TABS = 6
_P99_MS, _WORST_MS, _WORST_BUSY_MS = 250.0, 1000.0, 2000.0
_STATUS = """(name) => { location.hash = `#/machines/${name}`; }"""


def figures() -> Iterator[Figure]:
    conditions.allow_files()
    with tempfile.TemporaryDirectory(prefix="causticmill-stops-") as made:
        folder = Path(made)
        disk = None if (reason := missing_for_slow()) else slow_disk(folder, folder / "data" / "agents")
        if disk is None:
            yield Figure("stops: disk stalled", float("nan"), "", reason)
        environment = {} if disk is None else disk.environment
        with running_floor(folder, lines=_LINES, agent_environment=environment) as floor:
            floor.start()
            yield from _conditions(floor, disk)


def _conditions(floor: Floor, disk: SlowDisk | None) -> Iterator[Figure]:
    with (
        floor.agent_client(timeout_s=2 * PATIENCE_S) as bystander,
        contextlib.closing(BySocket(floor, floor.token)) as kept,
    ):
        presser = Presser(floor, bystander)
        ways = {"server": by_server(floor, floor.token), "socket": kept, "agent": by_agent(floor)}

        def pressed(name: str, lasts_s: float, *, most_ms: float = _WORST_MS) -> Iterator[Figure]:
            yield from _rows(name, presser, ways, lasts_s, most_ms=most_ms)

        yield from pressed("idle", _SHORT_S)
        with conditions.event_streams(floor):
            yield from pressed(f"{conditions.STREAMS} event streams", _SHORT_S)
        with conditions.locked_database(floor):
            yield from pressed(f"database locked, {conditions.READYZ} x /readyz wait", _LONG_S)
        if disk is not None:
            with disk.stalled():
                yield from pressed("disk stalled", _STALL_S)
        yield from _tabs(floor, presser)
        ended = floor.new_token("ended")
        conditions.expire(floor, "ended")
        yield from _rows("token expired", presser, {"server": by_server(floor, ended)}, _SHORT_S / 3)
        with conditions.silent_connections(floor):
            yield from pressed(f"{conditions.SILENT} silent connections", _SHORT_S)
        with conditions.slow_bodies(floor):
            yield from pressed(f"{conditions.SILENT} slow bodies", _SHORT_S)
        for count in (conditions.SILENT, 3000):
            with conditions.silent_sockets(floor, count):
                yield from pressed(f"{count} silent WebSockets", _SHORT_S)
        with conditions.bogus_tokens(floor):
            yield from pressed(f"{conditions.GUESSERS} callers with bogus tokens", _SHORT_S)
        with conditions.api_restarts(floor):
            yield from pressed("the API is killed every 4 s", _LONG_S)
        with conditions.locked_database(floor), conditions.api_restarts(floor):
            yield from pressed("the same, database locked", _LONG_S)
        with conditions.busy_computer():
            yield from pressed(f"{conditions.LOOPS} busy loops", _LONG_S, most_ms=_WORST_BUSY_MS)


def _rows(
    name: str, presser: Presser, ways: dict[str, Press], lasts_s: float, *, most_ms: float = _WORST_MS
) -> Iterator[Figure]:
    """A condition in which the run ends, or the mill cannot be resumed, is over, and said to be."""
    share = [*ways, *(way for way in ways if way != "agent")]
    lost = ""
    found: dict[str, Presses] = {way: Presses() for way in ways}
    try:
        presser.series(ways, lasts_s, share=share, into=found)
    except (AssertionError, httpx.HTTPError) as error:
        lost = f"; BROKEN OFF: {' '.join(str(error).split())[:160]}"
    load = f"load {os.getloadavg()[0]:.1f}"
    for way, presses in found.items():
        if not presses.took_s:
            yield Figure(f"HOLD, {name}, by {way}", float("nan"), "ms", f"not pressed{lost}")
            continue
        took_ms = [1000 * took_s for took_s in presses.took_s]
        missed = f"; {len(presses.missed)} never came ({presses.missed[-1]})" if presses.missed else ""
        note = f"n={len(took_ms)}, p50 {percentile(took_ms, 0.5):.3g} ms; {load}"
        p99, worst = percentile(took_ms, 0.99), max(took_ms)
        if most_ms == _WORST_MS:
            yield Figure(f"HOLD, {name}, by {way}, p99", p99, "ms", f"{note}; {_budget(p99, _P99_MS)}")
        yield Figure(f"HOLD, {name}, by {way}, worst", worst, "ms", f"{note}; {_budget(worst, most_ms)}{missed}{lost}")


def _budget(value_ms: float, most_ms: float) -> str:
    return f"budget <= {most_ms:g} ms{', MISSED' if value_ms > most_ms else ''}"


def _tabs(floor: Floor, presser: Presser) -> Iterator[Figure]:
    if reason := missing():
        yield Figure(f"HOLD, {_TABS} tabs", float("nan"), "", reason)
        return
    with running_browser() as browser, contextlib.closing(_Tabs(browser, floor)) as tabs:
        yield from _rows(f"{_TABS} tabs", presser, {"page": tabs.press}, _SHORT_S)


class _Tabs:
    """Six pages of one browser on the mill's screen; Space is pressed in the last one."""

    def __init__(self, browser: Browser, floor: Floor) -> None:
        self._context = browser.new_context(base_url=floor.url)
        self._context.set_default_timeout(1000 * PATIENCE_S)
        self._page = [self._open(floor) for _ in range(_TABS)][-1]
        self._page.bring_to_front()
        time.sleep(1.0)

    def press(self) -> str:
        self._page.keyboard.press("Space")
        return ""

    def close(self) -> None:
        self._context.close()

    def _open(self, floor: Floor) -> Page:
        page = self._context.new_page()
        page.goto("/")
        page.evaluate("async (token) => { await (await import('/page/lib/api.js')).api.useToken(token); }", floor.token)
        page.evaluate(_STATUS, MILL)
        page.get_by_role("heading", level=1, name=MILL).wait_for()
        return page
