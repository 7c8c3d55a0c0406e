"""Real workers that are killed, frozen and robbed of their database at random, and what must hold afterwards.

The stages are stand-ins that only wait (entries/storm_stages.py); workers, engine, database, store and the processes of
stages are the real ones.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from service.job.spec.loading import resolve_spec
from service.job.stages.table import plan
from service.server.database.jobs import JobBook
from service.server.database.records import JobState, NewJob, StageState
from service.server.database.schema import await_schema, open_database
from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Ticket
from service.settings import ServerSettings
from service.store.opening import open_store
from tests.waiting import PATIENCE_S, until

HERE = Path(__file__).parent
MARK = "STORM_NOTES"
TINY = ("image.pixels=32", "optics.width_mm=10", "optics.height_mm=10")


@dataclass
class Storm:
    """Workers by name, each with settings of its own; all share one database and one store."""

    folder: Path
    settings: dict[str, ServerSettings]
    pause_s: float = 0.1
    script: tuple[str, ...] = (str(HERE / "storm_worker.py"),)
    done: Counter[str] = field(default_factory=Counter)
    _workers: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.notes = self.folder / "storm"
        self.notes.mkdir(parents=True)
        self.first = next(iter(self.settings.values()))
        for name in self.settings:
            self.start(name)
        self.database = open_database(self.first)
        await_schema(self.database, PATIENCE_S)
        self.store = open_store(self.first)
        self.book = JobBook(self.database, self.store)
        self.engine = DbosEngine(self.first)

    # ------------------------------------------------------------------ workers

    def start(self, name: str) -> None:
        environment = self.settings[name].environment() | {
            MARK: str(self.notes),
            "STORM_PAUSE_S": str(self.pause_s),
            "PYTHONPATH": str(HERE / "entries"),
        }
        with (self.folder / f"{name}.log").open("ab") as log:
            self._workers[name] = subprocess.Popen(
                [sys.executable, *self.script], env=environment, stdout=log, stderr=log, cwd=HERE.parents[3]
            )

    def kill(self, name: str) -> None:
        """kill -9, and start again as a supervisor does."""
        self._workers[name].kill()
        self._workers[name].wait()
        self.start(name)

    def signal(self, name: str, number: signal.Signals) -> None:
        self._workers[name].send_signal(number)

    def revive(self) -> None:
        """Start again whoever has ended by itself."""
        for name, process in self._workers.items():
            if process.poll() is not None:
                self.done["restarted"] += 1
                self.start(name)

    def stop(self) -> None:
        """As an operator does it; nobody is left afterwards."""
        for process in self._workers.values():
            process.terminate()
        for process in self._workers.values():
            process.wait(timeout=PATIENCE_S)
        self.engine.close()
        self.database.dispose()

    # ------------------------------------------------------------------ jobs

    def submit(self, count: int, *, first: int = 0) -> list[str]:
        """Jobs that differ from each other from the map on."""
        picture = self.folder / "picture"
        picture.unlink(missing_ok=True)  # it may be the store's own file by now
        picture.write_bytes(b"a picture")
        stored = self.store.put_file(picture)
        made = []
        for number in range(first, first + count):
            spec = resolve_spec(preset="draft", overrides=[*TINY, f"optics.throw_mm={100 + number}"]).plain()
            new = NewJob(
                name="a.png",
                spec=spec,
                image_sha256=stored.sha256,
                image_bytes=stored.bytes,
                created_by="storm",
                request_sha256="",
            )
            job, _ = self.book.create(new)
            if number % 5:  # every fifth is as if the API had died before it told the engine
                with contextlib.suppress(Exception):
                    self.engine.submit(Ticket(job.id, 1), priority=job.priority)
            made.append(job.id)
        return made

    def await_all(self, jobs: list[str]) -> None:
        def ended() -> bool:
            self.revive()
            try:
                return all(self.book.get(job_id).ended for job_id in jobs)
            except Exception:  # the database is just being restarted
                return False

        until(ended, what="the end of all jobs")

    def noted(self, word: str) -> list[dict[str, object]]:
        path = self.notes / "notes"
        lines = path.read_text().splitlines() if path.exists() else []
        return [note for line in lines if (note := json.loads(line))["word"] == word]

    # ------------------------------------------------------------------ what must hold

    def broken(self, jobs: list[str]) -> list[str]:
        """A line for each law that does not hold."""
        lines = [f"doubled: {note}" for note in self.noted("doubled")]
        for job_id in jobs:
            lines += self._broken_job(job_id)
        return lines

    def _broken_job(self, job_id: str) -> list[str]:
        job, runs, events = self.book.get(job_id), self.book.list_stages(job_id), self.book.list_events(job_id)
        lines = [] if job.state == JobState.SUCCEEDED else [f"lost: {job_id} is {job.state}: {job.error}"]
        for stage in plan(resolve_spec(preset="draft", overrides=TINY)):
            states = [run.state for run in runs if run.stage == stage]
            if states.count(StageState.COMMITTED) + states.count(StageState.REUSED) != 1:
                lines.append(f"run again: {job_id} {stage}: {states}")
            elif states[-1] not in (StageState.COMMITTED, StageState.REUSED):
                lines.append(f"begun after its end: {job_id} {stage}: {states}")
        if [event.seq for event in events] != list(range(1, len(events) + 1)) or events[-1].kind != "ended":
            lines.append(f"events: {job_id}: {[(event.seq, event.kind) for event in events]}")
        for artifact in self.book.list_artifacts(job_id):
            content = b"".join(self.store.open_range(artifact.sha256))
            if hashlib.sha256(content).hexdigest() != artifact.sha256:
                lines.append(f"half a file: {job_id} {artifact.name}")
        return lines

    def left_over(self) -> list[str]:
        """Processes that outlived their worker, and files in the scratch folders."""
        lines = [f"process {pid}: {words}" for pid, words in self.kin()]
        for settings in self.settings.values():
            lines += [f"scratch: {path}" for path in settings.scratch.rglob("*") if path.is_file()]
        return lines

    def kin(self) -> list[tuple[int, str]]:
        """Every living process that was started by this storm."""
        found = []
        for folder in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if not folder.name.isdigit() or int(folder.name) == os.getpid():
                    continue
                if f"{MARK}={self.notes}".encode() in (folder / "environ").read_bytes():
                    found.append((int(folder.name), (folder / "cmdline").read_text().replace("\0", " ")))
        return found


def rage(
    storm: Storm, *, seed: int, kills: int, calm_s: tuple[float, float], restart: Callable[[], None] | None
) -> None:
    """kill -9 of workers and of stages, SIGSTOP for two leases, and now and then a crash of the database."""
    chance, names = random.Random(seed), list(storm.settings)
    hit: Counter[tuple[object, object]] = Counter()
    frozen: list[tuple[float, str]] = []
    while storm.done.total() - storm.done["restarted"] < kills:
        time.sleep(chance.uniform(*calm_s))
        storm.revive()
        for until_at, name in list(frozen):
            if time.monotonic() > until_at:
                storm.signal(name, signal.SIGCONT)
                frozen.remove((until_at, name))
        what = chance.choices(["worker", "stage", "freeze", "database"], [5, 4, len(names) - 1, restart is not None])[0]
        name = chance.choice(names)
        if what == "worker" and name not in [one for _, one in frozen]:
            storm.kill(name)
        elif what == "stage" and not _kill_stage(storm, chance, hit):
            continue
        elif what == "freeze" and not frozen:
            storm.signal(name, signal.SIGSTOP)
            frozen.append((time.monotonic() + 2 * storm.first.lease_s, name))
        elif what == "database" and restart is not None:
            restart()
        elif what != "stage":
            continue
        storm.done[what] += 1
    for _, name in frozen:
        storm.signal(name, signal.SIGCONT)


def _kill_stage(storm: Storm, chance: random.Random, hit: Counter[tuple[object, object]]) -> bool:
    """Kill a stage at work; each at most twice, as the third crash of one stage fails its job, rightly."""
    over = {(note["pid"], note["job"], note["stage"]) for note in storm.noted("end")}
    begun = [note for note in storm.noted("begin") if (note["pid"], note["job"], note["stage"]) not in over]
    at_work = [
        note for note in begun if hit[(note["job"], note["stage"])] < 2 and Path(f"/proc/{note['pid']}").exists()
    ]
    if not at_work:
        return False
    note = chance.choice(at_work)
    hit[(note["job"], note["stage"])] += 1
    with contextlib.suppress(ProcessLookupError):
        os.kill(int(str(note["pid"])), signal.SIGKILL)
    return True
