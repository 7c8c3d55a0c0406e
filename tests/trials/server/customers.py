"""People who submit jobs and do not let go: each request has a key and is sent again until it is answered."""

from __future__ import annotations

import json
import random
import threading
import time
import uuid
from dataclasses import dataclass, field
from typing import Any

import httpx

from tests.trials.server.pictures import picture

ENDED = ("succeeded", "failed", "cancelled")


@dataclass(slots=True)
class Order:
    """One job as a person wants it. kind: orders of one kind ask for the same thing. ids: every id an answer named."""

    kind: int
    key: str = field(default_factory=lambda: str(uuid.uuid4()))
    ids: set[str] = field(default_factory=set)
    tries: int = 0
    refused: str = ""

    @property
    def spec(self) -> dict[str, Any]:
        return {
            "preset": "draft",
            "image": {"pixels": 64},
            "optics": {"width_mm": 20, "height_mm": 20, "throw_mm": 60 + 3 * (self.kind % 50)},
            "stock": {"margin_mm": 3},
        }


class Customers:
    """Submit the orders from several threads, a few at a time, and wait for their ends."""

    def __init__(self, url: str, orders: list[Order], *, threads: int = 3, patience_s: float = 180.0) -> None:
        self.orders = orders
        self.acked: dict[str, Order] = {}
        self.url = url
        self._left = list(orders)
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._threads = [threading.Thread(target=self._work, args=(seed,), daemon=True) for seed in range(threads)]

    def begin(self) -> None:
        for thread in self._threads:
            thread.start()

    def join(self) -> None:
        for thread in self._threads:
            thread.join()

    def states(self) -> dict[str, str]:
        """State of every job that the server knows; an empty dict while it does not answer."""
        found: dict[str, str] = {}
        address = "/v1/jobs?limit=200"
        try:
            with httpx.Client(base_url=self.url, timeout=10.0, trust_env=False) as http:
                while address:
                    page = http.get(address).raise_for_status().json()
                    found |= {job["id"]: job["state"] for job in page["jobs"]}
                    address = page.get("next")
        except httpx.HTTPError:
            return {}
        return found

    def all_ended(self) -> bool:
        states = self.states()
        return bool(states) and all(states.get(job_id, "succeeded") in ENDED for job_id in {*self.acked, *states})

    def _work(self, seed: int) -> None:
        chance = random.Random(seed)
        while True:
            with self._lock:
                if not self._left:
                    return
                order = self._left.pop(0)
            self._insist(order, chance)
            time.sleep(chance.uniform(0.0, 0.5))

    def _insist(self, order: Order, chance: random.Random) -> None:
        """Send until it is acknowledged; now and then once more after that."""
        give_up_s = time.monotonic() + self._patience_s
        extra = chance.random() < 0.2
        while time.monotonic() < give_up_s:
            if (job_id := self._sent(order)) is not None:
                with self._lock:
                    order.ids.add(job_id)
                    self.acked[job_id] = order
                if not extra:
                    return
                extra = False
            elif order.refused:
                return
            time.sleep(chance.uniform(0.02, 0.3))
        order.refused = order.refused or "never answered"

    def _sent(self, order: Order) -> str | None:
        order.tries += 1
        try:
            answer = httpx.post(
                f"{self.url}/v1/jobs",
                files={"image": (f"picture-{order.kind}.png", picture(order.kind % 3))},
                data={"spec": json.dumps(order.spec)},
                headers={"Idempotency-Key": order.key},
                timeout=15.0,
                trust_env=False,
            )
        except httpx.HTTPError:
            return None
        if answer.status_code == 202:
            return str(answer.json()["id"])
        if answer.status_code < 500 and answer.status_code != 429:
            order.refused = answer.text[:300]
        return None
