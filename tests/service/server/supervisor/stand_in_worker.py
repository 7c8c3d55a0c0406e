"""A process in the place of the worker. WORKER_DOES says how it behaves; a stage of it is a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path


def main() -> int:
    does = os.environ.get("WORKER_DOES", "works")
    starts = Path(os.environ["CAUSTICMILL_DATA"], "starts")
    starts.write_text(starts.read_text() + "x" if starts.exists() else "x")
    if does == "refuses" or (does == "refuses the second time" and starts.read_text() == "xx"):
        sys.stderr.write("error: CAUSTICMILL_SLOTS: this worker wants another value\n")
        return 2
    if does == "fails":
        sys.stderr.write("error: the database cannot be used: no such host\n")
        return 1
    if does == "crashes":
        return 3
    if does == "sick":
        from service.processes import lifeline

        lifeline.healthy = lambda: False
    code = (
        "import ctypes,os,signal,time; ctypes.CDLL(None).prctl(1, signal.SIGKILL); print(flush=True); time.sleep(600)"
    )
    stage = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    assert stage.stdout is not None and stage.stdout.readline(), "it dies with us from now on"

    def stop(*_: object) -> None:
        if does == "deaf":
            return
        stage.kill()
        stage.wait()
        sys.stderr.write("worker ends well\n")
        sys.exit(0)

    signal.signal(signal.SIGTERM, stop)
    Path(os.environ["CAUSTICMILL_DATA"], "stage.pid").write_text(str(stage.pid))
    while True:
        time.sleep(60)


if __name__ == "__main__":
    sys.exit(main())
