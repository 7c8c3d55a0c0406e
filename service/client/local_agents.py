"""Stop a run through the agents of this computer's mills, if no server answers."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import httpx

from service.errors import InputError
from service.milling.agent.card import AgentCard, read_card, read_token
from service.milling.agent.settings import state_home

_DATA, _USUAL_DATA = "CAUSTICMILL_DATA", "causticmill-data"
_TIMEOUT = httpx.Timeout(3.0, connect=1.0)


def stop_at_agents(run_id: str, stop: str, environment: Mapping[str, str] = os.environ) -> str | None:
    """Stop a run at the agent that has it; return its machine, or None if no agent has stopped it.

    Agents are found by the cards that `serve` and `mill` of this account have written.
    """
    for card, token in _list_agents(environment):
        with contextlib.suppress(httpx.HTTPError):
            headers = {"Authorization": f"Bearer {token}"}
            url = f"{card.url}/v1/runs/{run_id}:{stop}"
            if httpx.post(url, headers=headers, timeout=_TIMEOUT, trust_env=False).status_code == 202:
                return card.machine
    return None


def _list_agents(environment: Mapping[str, str]) -> Iterator[tuple[AgentCard, str]]:
    homes = (Path(environment.get(_DATA) or _USUAL_DATA) / "agents", state_home())
    for folder in (folder for home in homes if home.is_dir() for folder in sorted(home.iterdir())):
        if (card := read_card(folder)) is not None:
            with contextlib.suppress(InputError):
                yield card, read_token(Path(card.token_file))
