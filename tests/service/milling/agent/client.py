"""An agent as its callers meet it: told over HTTP on a loopback port."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx

from service.milling.agent.card import AgentCard, read_card
from tests.waiting import PATIENCE_S, seen

CHECKS = ["tool", "zero", "stock", "clear"]


class AgentClient:
    """Of the agent at `url` that owns `folder`."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder, url
        self.control = ""
        self.token = (folder / "token").read_text().strip()
        self.http = httpx.Client(
            base_url=url, headers={"Authorization": f"Bearer {self.token}"}, timeout=PATIENCE_S, trust_env=False
        )

    def get(self, path: str) -> Any:
        answer = self.http.get(path)
        answer.raise_for_status()
        return answer.json()

    def post(self, path: str, status: int, **body: object) -> Any:
        answer = self.give(path, body)
        assert answer.status_code == status, answer.text
        return answer.json()

    def give(self, path: str, body: object) -> httpx.Response:
        """As the job server does: an order is given under a grant, asked for at the press, by who has control."""
        if not (path.startswith("/v1/control/") or path.endswith((":start", ":resume", ":recover"))):
            return self.http.post(path, json=body)
        return self.http.post(path, json=body, headers=self.ask_grant())

    def ask_grant(self) -> dict[str, str]:
        """Headers of one order."""
        taken = self.http.post(
            "/v1/lease",
            json={"operator": "Ada", "principal": "ada", "take_over": True},
            headers={"Causticmill-Control": self.control},
        )
        self.control = str(taken.json()["control"])
        headers = {"Causticmill-Control": self.control}
        return headers | {"Causticmill-Grant": self.http.post("/v1/grants", headers=headers).json()["grant"]}

    def start(self, path: Path) -> str:
        """Bring, park and start a program; the run's id."""
        run = self.post("/v1/runs", 201, program=self.upload(path), name=path.name)
        assert run["state"] == "parked"
        self.post(f"/v1/runs/{run['id']}:start", 202, operator="Ada", checks=CHECKS)
        return str(run["id"])

    def status(self) -> Any:
        return self.get("/v1/status")

    def until(self, good: Callable[[Any], bool]) -> Any:
        """Wait for a status; returns it."""
        return seen(self.status, good, every_s=0.02)

    def upload(self, path: Path) -> str:
        data = path.read_bytes()
        sha256 = hashlib.sha256(data).hexdigest()
        answer = self.http.put(f"/v1/programs/{sha256}", content=data)
        assert answer.status_code in (200, 201), answer.text
        return sha256

    @contextlib.contextmanager
    def events(self, last_id: str = "") -> Iterator[Iterator[dict[str, str]]]:
        headers = {"Last-Event-ID": last_id} if last_id else {}
        with self.http.stream("GET", "/v1/events", headers=headers) as answer:
            assert answer.status_code == 200
            yield _events(answer.iter_lines())


def await_agent(folder: Path) -> AgentCard:
    def answers() -> bool:
        card = read_card(folder)
        if card is None:
            return False
        with contextlib.suppress(httpx.HTTPError):
            return httpx.get(f"{card.url}/livez", trust_env=False, verify=False, timeout=PATIENCE_S).status_code == 200
        return False

    seen(answers, bool, every_s=0.02)
    card = read_card(folder)
    assert card is not None
    return card


def _events(lines: Iterator[str]) -> Iterator[dict[str, str]]:
    event: dict[str, str] = {}
    for line in lines:
        if not line:
            if "data" in event:
                yield event
            event = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(": ")
            event[name] = value
