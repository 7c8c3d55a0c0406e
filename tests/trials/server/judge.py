"""What must hold after a storm. Each broken law is a line."""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import sqlalchemy as sa

from service.server.database.records import StageState
from service.server.database.tables import jobs, stage_runs
from tests.trials.server.customers import Order

_HASH = re.compile(r"[0-9a-f]{64}")
# They tell of times, of the picture's name and of tries: equal jobs may differ in them.
_OWN = re.compile(r"report(-\w+)?\.(json|html)|setup-sheet\.pdf|.*\.log")
_MUST_HAVE = {
    "spec.json", "report.json", "report.html", "setup-sheet.pdf", "target.png", "map.npz", "heightfield.npz",
    "lens.stl", "caustic.png", "through-focus.png", "toolpath.png", "caustic-as-milled.png", "as-milled.png",
}  # fmt: skip


@dataclass(slots=True)
class Verdict:
    """lost, doubled, run_again, half, differing: lines, one for each fault.

    stages: how many were started, committed...; equal: how many jobs were compared with an equal one
    """

    lost: list[str] = field(default_factory=list)
    doubled: list[str] = field(default_factory=list)
    run_again: list[str] = field(default_factory=list)
    half: list[str] = field(default_factory=list)
    differing: list[str] = field(default_factory=list)
    jobs: int = 0
    equal: int = 0
    files: int = 0
    stages: dict[str, int] = field(default_factory=lambda: defaultdict(int))


def judged(url: str, orders: list[Order], states: dict[str, str]) -> Verdict:
    """Ask the server about every job."""
    verdict = Verdict(jobs=len(states))
    known = {job_id for order in orders for job_id in order.ids}
    verdict.doubled += [f"key {order.key} made {sorted(order.ids)}" for order in orders if len(order.ids) > 1]
    verdict.lost += [
        f"order of kind {o.kind}: {o.refused or 'no job'} after {o.tries} tries" for o in orders if not o.ids
    ]
    verdict.lost += [f"job {job_id} is not known" for job_id in sorted(known - set(states))]
    verdict.doubled += [f"job {job_id} belongs to no order" for job_id in sorted(set(states) - known)]
    kinds: dict[int, dict[str, str]] = {}
    with httpx.Client(base_url=url, timeout=60.0, trust_env=False) as http:
        for order in orders:
            for job_id in order.ids & set(states):
                _judge_job(http, job_id, verdict)
                _judge_files(http, job_id, order.kind, kinds, verdict)
    return verdict


def _judge_job(http: httpx.Client, job_id: str, verdict: Verdict) -> None:
    job = http.get(f"/v1/jobs/{job_id}").raise_for_status().json()
    if job["state"] != "succeeded":
        verdict.lost.append(f"job {job_id} ended {job['state']}: {job['error']}")
    events = _events(http, job_id)
    if [event["id"] for event in events] != list(range(1, len(events) + 1)):
        verdict.doubled.append(f"job {job_id}: event ids {[event['id'] for event in events][:20]}")
    if (ends := sum(event["kind"] == "ended" for event in events)) != 1 or events[-1]["kind"] != "ended":
        verdict.doubled.append(f"job {job_id}: {ends} ends, last event {events[-1]['kind']}")
    done: set[str] = set()
    for event in events:
        stage = event["data"].get("stage")
        verdict.stages[event["kind"]] += 1
        if event["kind"] == "stage.started" and stage in done:
            verdict.run_again.append(f"job {job_id}: {stage} began again after it was committed")
        if event["kind"] in ("stage.committed", "stage.reused"):
            if stage in done:
                verdict.run_again.append(f"job {job_id}: {stage} was committed twice")
            done.add(stage)
    if missing := {row["name"] for row in job["stages"]} - done:
        verdict.lost.append(f"job {job_id}: never committed {sorted(missing)}")


def _judge_files(
    http: httpx.Client, job_id: str, kind: int, kinds: dict[int, dict[str, str]], verdict: Verdict
) -> None:
    """All there, each as its hash says, and the same as those of an equal job."""
    listing = http.get(f"/v1/jobs/{job_id}/artifacts").raise_for_status().json()["artifacts"]
    hashes = {item["name"]: item["sha256"] for item in listing}
    programs = [name for name in hashes if name.startswith("pass-")]
    if missing := _MUST_HAVE - set(hashes):
        verdict.half.append(f"job {job_id} lacks {sorted(missing)}")
    if not [name for name in programs if name.endswith(".nc")]:
        verdict.half.append(f"job {job_id} has no program")
    for item in listing:
        content = _content(http, item["url"])
        verdict.files += 1
        if hashlib.sha256(content).hexdigest() != item["sha256"] or len(content) != item["bytes"]:
            verdict.half.append(f"job {job_id}: {item['name']} is not what its hash says")
    plain = {name: value for name, value in hashes.items() if not _OWN.fullmatch(name)}
    verdict.equal += kind in kinds
    if (others := kinds.setdefault(kind, plain)) != plain:
        differ = sorted(name for name in {*plain, *others} if plain.get(name) != others.get(name))
        verdict.differing.append(f"job {job_id} differs from an equal job in {differ}")


def _content(http: httpx.Client, url: str) -> bytes:
    """Nothing, where the server refuses, or breaks off: then the file is not what its hash says."""
    try:
        return http.get(url).raise_for_status().content
    except httpx.HTTPError:
        return b""


def _events(http: httpx.Client, job_id: str) -> list[dict[str, Any]]:
    """The whole history; the stream of an ended job ends by itself."""
    found: list[dict[str, Any]] = []
    text = http.get(f"/v1/jobs/{job_id}/events").raise_for_status().text
    for block in text.split("\n\n"):
        fields = dict(line.split(": ", 1) for line in block.splitlines() if ": " in line and not line.startswith(":"))
        if "id" in fields and "data" in fields:
            found.append({"id": int(fields["id"]), "kind": fields["event"], "data": json.loads(fields["data"])})
    return found


def half_objects(store: Path) -> list[str]:
    """Objects of a store folder whose content is not their name, and whatever else lies there."""
    faults = []
    for path in store.rglob("*"):
        if path.is_dir() or path == store / "guard":
            continue
        if not _HASH.fullmatch(path.name):
            faults.append(f"left over: {path.relative_to(store)}")
            continue
        with path.open("rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != path.name:
                faults.append(f"half: {path.relative_to(store)}")
    return faults


def left_over(data: Path) -> list[str]:
    """Files of work that is over: scratch and uploads must be empty."""
    places = [data / "scratch", data / "uploads"]
    return [
        str(path.relative_to(data)) for place in places if place.is_dir() for path in place.rglob("*") if path.is_file()
    ]


def tries_faults(database_url: str) -> list[str]:
    """What the table of tries says by itself: in each attempt of a job every stage is done once, and then no more."""
    engine = sa.create_engine(database_url.replace("postgresql://", "postgresql+psycopg://", 1))
    query = sa.select(stage_runs.c.job_id, stage_runs.c.attempt, stage_runs.c.stage, stage_runs.c.state)
    with engine.connect() as connection:
        rows = connection.execute(query.order_by(stage_runs.c.id)).all()
        ended = {*connection.execute(sa.select(jobs.c.id).where(jobs.c.ended_at.is_not(None))).scalars()}
    engine.dispose()
    done: Counter[tuple[str, int, str]] = Counter()
    faults = []
    for job_id, attempt, stage, state in rows:
        if done[job_id, attempt, stage]:
            faults.append(f"job {job_id}: a try of {stage} ({state}) after it was done")
        if state == StageState.RUNNING and job_id in ended:
            faults.append(f"job {job_id}: a try of {stage} is open, and the job has ended")
        done[job_id, attempt, stage] += state in (StageState.COMMITTED, StageState.REUSED)
    return faults


def database_faults(path: Path) -> list[str]:
    """SQLite's own word about a file of its."""
    with sqlite3.connect(path) as connection:
        found = [row[0] for row in connection.execute("PRAGMA integrity_check")]
        found += [f"row without its parent: {row}" for row in connection.execute("PRAGMA foreign_key_check")]
    connection.close()
    return [f"{path.name}: {line}" for line in found if line != "ok"]
