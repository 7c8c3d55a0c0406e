"""What the server's figures share: a caller, events with their times, and percentiles."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import httpx

from tests.benchmarks.timing import Figure
from tests.trials.server.pictures import picture

SMALL = {"preset": "draft", "image": {"pixels": 64}, "optics": {"width_mm": 20, "height_mm": 20}}
LONG = {"preset": "paper", "image": {"pixels": 512}}


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
            time.sleep(0.1)
        return job

    def events(self, job_id: str, *, read_s: float = 120.0) -> Iterator[Said]:
        """As they come, with those that have no number (progress), until the stream ends."""
        kind = ""
        with self.http.stream(
            "GET", f"/v1/jobs/{job_id}/events", timeout=httpx.Timeout(read_s, connect=10.0)
        ) as answer:
            for line in answer.iter_lines():
                name, _, value = line.partition(": ")
                if name == "event":
                    kind = value
                elif name == "data":
                    yield Said(kind, json.loads(value), time.time())

    def first(self, job_id: str, *kinds: str) -> Said:
        """The first event of one of these kinds."""
        return next(said for said in self.events(job_id) if said.kind in kinds)


def percentile(values: Sequence[float], share: float) -> float:
    """The smallest value that so many are not above: of few values the largest."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


def spread(name: str, seconds: Sequence[float], *, unit: str = "ms", note: str = "") -> Iterator[Figure]:
    """Median and 99th percentile."""
    factor = 1000.0 if unit == "ms" else 1.0
    words = f"n={len(seconds)}, most {factor * max(seconds):.3g} {unit}{'; ' + note if note else ''}"
    yield Figure(f"{name}, p50", factor * percentile(seconds, 0.5), unit, words)
    yield Figure(f"{name}, p99", factor * percentile(seconds, 0.99), unit, words)
