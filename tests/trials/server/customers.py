"""People who submit jobs and do not let go: each request has a key and is sent again until it is answered."""

from __future__ import annotations

import json
import random
import threading
import time
import uuid
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import httpx

from tests.trials.server.pictures import picture

ENDED = ("succeeded", "failed", "cancelled")
_BORED_S = (0.2, 0.8)  # between two requests of somebody who asks for what he has already
_ROUGH = {"name": "rough", "radius_mm": 1.5, "pitch_mm": 1.0, "stock_to_leave_mm": 0.2, "step_down_mm": 2}


@dataclass(slots=True)
class Order:
    """One job as a person wants it. kind: orders of one kind ask for the same thing. ids: every id an answer named.

    Kinds 2n and 2n + 1 differ in the pitch of the last pass only.
    """

    kind: int
    key: str = field(default_factory=lambda: str(uuid.uuid4()))
    ids: set[str] = field(default_factory=set)
    tries: int = 0
    refused: str = ""

    @property
    def spec(self) -> dict[str, Any]:
        """A real job, as small as a lens can be: what is tried here is the server."""
        finish = {"name": "finish", "radius_mm": 1.5, "pitch_mm": 0.5 if self.kind % 2 else 0.4}
        return {
            "preset": "draft",
            "image": {"pixels": 32},
            "optics": {"width_mm": 6, "height_mm": 6, "throw_mm": 60 + 2 * (self.kind // 2)},
            "stock": {"margin_mm": 1},
            "passes": [_ROUGH, finish],
        }


class Customers:
    """Submit orders from several threads as they are released; meanwhile somebody asks again for what is there."""

    def __init__(self, url: str, orders: list[Order], *, threads: int = 3, patience_s: float = 300.0) -> None:
        self.orders = orders
        self.url = url
        self.answers: Counter[int] = Counter()
        self.faults: list[str] = []
        self._left: list[Order] = []
        self._open = 0
        self._asking = 0
        self._patience_s = patience_s
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._threads = [threading.Thread(target=self._work, args=(seed,), daemon=True) for seed in range(threads)]
        self._threads.append(threading.Thread(target=self._doubt, daemon=True))

    def begin(self) -> None:
        for thread in self._threads:
            thread.start()

    def release(self, count: int) -> None:
        """Of all orders so many may have been sent."""
        with self._lock:
            self._left += self.orders[self._open : count]
            self._open = max(self._open, min(count, len(self.orders)))

    def add(self, orders: list[Order]) -> None:
        with self._lock:
            self.orders += orders

    def close(self) -> None:
        """Everything that was released is sent; then they go home."""
        self._closed.set()
        for thread in self._threads:
            thread.join()

    @property
    def posting(self) -> bool:
        """Is one of them waiting for an answer just now?"""
        return self._asking > 0

    @property
    def acked(self) -> set[str]:
        return {job_id for order in self.orders for job_id in order.ids}

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
        """An acknowledged job that the server does not know has ended, too: badly."""
        states = self.states()
        return bool(states) and all(state in ENDED for state in states.values())

    def _work(self, seed: int) -> None:
        chance = random.Random(seed)
        while True:
            with self._lock:
                order = self._left.pop(0) if self._left else None
            if order is not None:
                self._insist(order, chance)
            elif self._closed.wait(0.2):
                return

    def _doubt(self) -> None:
        """Asks for what was ordered already, with the key of that: the answer must be the same job."""
        chance = random.Random(99)
        while not self._closed.wait(chance.uniform(*_BORED_S)):
            if known := [order for order in self.orders if order.ids]:
                self._send(chance.choice(known))

    def _insist(self, order: Order, chance: random.Random) -> None:
        """Send until it is acknowledged."""
        give_up_s = time.monotonic() + self._patience_s
        while time.monotonic() < give_up_s and not order.refused:
            self._send(order)
            if order.ids:
                return
            time.sleep(chance.uniform(0.02, 0.3))
        order.refused = order.refused or "never answered"

    def _send(self, order: Order) -> None:
        order.tries += 1
        with self._lock:
            self._asking += 1
        try:
            answer = httpx.post(
                f"{self.url}/v1/jobs",
                files={"image": (f"picture-{order.kind % 3}.png", picture(order.kind // 2 % 3))},
                data={"spec": json.dumps(order.spec)},
                headers={"Idempotency-Key": order.key},
                timeout=15.0,
                trust_env=False,
            )
        except httpx.HTTPError:
            self.answers[0] += 1
            return
        finally:
            with self._lock:
                self._asking -= 1
        self._hear(order, answer)

    def _hear(self, order: Order, answer: httpx.Response) -> None:
        self.answers[answer.status_code] += 1
        if answer.status_code == 202:
            with self._lock:
                order.ids.add(str(answer.json()["id"]))
        elif answer.status_code == 500:
            self.faults.append(f"answer 500: {answer.text[:200]}")
        elif answer.status_code < 500 and answer.status_code != 429:
            order.refused = answer.text[:300]
