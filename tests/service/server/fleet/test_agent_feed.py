"""The event stream of an agent, read once for many: who falls behind loses nothing in the middle."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Mapping

import pytest

from service.server.fleet.agent_feed import AgentFeed


class LostError(Exception): ...


def lost(words: str, code: str, values: Mapping[str, object]) -> Exception:
    return LostError(words)


def test_a_reader_that_falls_behind_gets_no_gap_before_its_end() -> None:
    """It comes back with the id of the last event it had: what it had not before that one it would never get."""
    begun = asyncio.Event()

    @contextlib.asynccontextmanager
    async def opened(_last_id: str) -> AsyncIterator[AsyncIterator[str]]:
        async def lines() -> AsyncIterator[str]:
            for number in range(3000):
                for line in (f"id: a-{number}", "event: event", "data: {}", ""):
                    yield line
                if number == 0:
                    await begun.wait()  # the rest comes without a pause
            await asyncio.Event().wait()

        yield lines()

    async def trial() -> list[int]:
        got = []
        stream = AgentFeed(opened, lost).follow("")
        with pytest.raises(LostError, match="does not keep up"):
            async for message in stream:
                begun.set()
                got.append(int(message.id.partition("-")[2]))
        return got

    got = asyncio.run(trial())
    assert got == list(range(len(got))) and len(got) > 1000
