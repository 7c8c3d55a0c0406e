"""The worker's process is told to stop at any moment, also while it begins to wait for that."""

from __future__ import annotations

import subprocess
import sys

from tests.waiting import PATIENCE_S

SIGNALS = 20_000
SCRIPT = f"""
import os, random, signal, threading, time
from service.server.worker.main import catch_stop

told = heard = 0
def tell():
    global told
    while told < {SIGNALS}:
        if told > heard:
            time.sleep(0)
            continue
        for _ in range(random.randrange(200)):
            pass
        told += 1
        os.kill(os.getpid(), signal.SIGTERM)

end = catch_stop()
threading.Thread(target=tell, daemon=True).start()
while heard < {SIGNALS}:
    heard += len(end.recv(1))
"""


def test_no_signal_is_lost_between_two_waits() -> None:
    """Each is sent at a random moment after the one before was heard; a lost one is waited for without end."""
    assert subprocess.run([sys.executable, "-c", SCRIPT], timeout=PATIENCE_S).returncode == 0
