"""A caller of the server, and events with the times at which they came."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import httpx

from tests.trials.server.customers import Order
from tests.trials.server.pictures import picture

SMALL = Order(kind=0).spec  # a real job of a few seconds
LONG = {"preset": "paper", "image": {"pixels": 512}}  # its stages take longer than anybody waits here


@dataclass(frozen=True, slots=True)
class Said:
    """An event, and when it arrived here."""

    kind: str
    data: dict[str, Any]
    came: float

    @property
    def at(self) -> float:
        return datetime.fromisoformat(self.data["at"]).timestamp()


class Customer:
    def __init__(self, url: str) -> None:
        self.http = httpx.Client(base_url=url, timeout=60.0, trust_env=False)

    def __enter__(self) -> Customer:
        return self

    def __exit__(self, *_: object) -> None:
        self.http.close()

    def submit(self, spec: dict[str, Any], *, pixels: int = 64, throw_mm: float = 100.0) -> str:
        """A job whose lens no other has, if no other has this throw."""
        whole = spec | {"optics": spec.get("optics", {}) | {"throw_mm": throw_mm}}
        files = {"image": ("picture.png", picture(0, pixels))}
        answer = self.http.post("/v1/jobs", files=files, data={"spec": json.dumps(whole)})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    def job(self, job_id: str) -> dict[str, Any]:
        return dict(self.http.get(f"/v1/jobs/{job_id}").raise_for_status().json())

    def cancel(self, job_id: str) -> None:
        self.http.post(f"/v1/jobs/{job_id}:cancel").raise_for_status()

    def ended(self, job_id: str, patience_s: float = 300.0) -> dict[str, Any]:
        give_up_s = time.monotonic() + patience_s
        while (job := self.job(job_id))["state"] in ("queued", "running"):
            assert time.monotonic() < give_up_s, job
            time.sleep(0.05)
        return job

    def done(self, spec: dict[str, Any], *, throw_mm: float = 100.0) -> dict[str, Any]:
        """A job that has succeeded."""
        job = self.ended(self.submit(spec, throw_mm=throw_mm))
        assert job["state"] == "succeeded", job["error"]
        return job

    def events(self, job_id: str, *, read_s: float = 120.0) -> Iterator[Said]:
        """As they come, with those that have no number (progress), until the stream ends."""
        kind = ""
        limits = httpx.Timeout(read_s, connect=10.0)
        with self.http.stream("GET", f"/v1/jobs/{job_id}/events", timeout=limits) as answer:
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if name == "event":
                    kind = value
                elif name == "data":
                    yield Said(kind, json.loads(value), time.time())

    def until(self, job_id: str, kind: str) -> dict[str, float]:
        """When each kind of event happened, up to the first of this kind."""
        found: dict[str, float] = {}
        for said in self.events(job_id):
            if "at" in said.data:
                found.setdefault(said.kind, said.at)
            if said.kind == kind:
                return found
        raise AssertionError(f"the stream of {job_id} ended without {kind}: {found}")
