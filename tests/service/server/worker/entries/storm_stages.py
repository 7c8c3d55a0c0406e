"""Stand-ins for all stages, fast and honest: each waits a little, makes one file that depends on what it reads, and
notes when it begins and ends. A second one at work on the same job at the same time is noted as doubled."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from pathlib import Path

from service.settings import ServerSettings
from service.store.opening import open_store

NOTES = Path(os.environ["STORM_NOTES"])
PAUSE_S = float(os.environ.get("STORM_PAUSE_S", "0.1"))


def note(**words):
    with (NOTES / "notes").open("a") as file:
        file.write(json.dumps({"pid": os.getpid(), "at": time.time(), **words}) + "\n")


def run(order, on_progress):
    about = {"job": order["job_id"], "stage": order["stage"]}
    with (NOTES / f"lock-{order['job_id']}").open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            note(word="doubled", **about)
        note(word="begin", **about)
        scratch = Path(order["scratch"])
        scratch.mkdir(parents=True, exist_ok=True)
        for step in range(5):
            on_progress(step / 5)
            time.sleep(PAUSE_S / 5)
        path = scratch / "out"
        made = json.dumps([order["stage"], order["spec"], sorted(order["inputs"].items())]).encode() * 100
        path.write_bytes(made)
        stored = open_store(ServerSettings.load()).put_file(path)
        path.unlink(missing_ok=True)
        scratch.rmdir()
        assert stored.sha256 == hashlib.sha256(made).hexdigest()
        note(word="end", **about)
    files = {f"{order['stage']}.out": {"sha256": stored.sha256, "bytes": stored.bytes}}
    return {"outputs": files, "report": {}, "notes": {}, "seconds": PAUSE_S, "peak_rss_mb": 1.0}
