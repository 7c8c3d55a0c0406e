"""Stages that do what a test asks for: found by the fork server as `odd_stages:run`. Standard library only."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path


def run(order, on_progress):
    return globals()[order["do"]](order, on_progress)


def echo(order, on_progress):
    print("said on stdout")
    print("said on stderr", file=sys.stderr)
    for step in range(5):
        on_progress(step / 4)
        time.sleep(order.get("pause_s", 0.0))
    return {
        "said": order.get("say"),
        "pid": os.getpid(),
        "open": [file.name for file in Path("/proc/self/fd").iterdir()],
    }


def chat(order, on_progress):
    """Many lines, of which the first and the last are known."""
    print("the first line")
    for number in range(order["lines"]):
        print(f"line {number} " + "x" * 90)
    print("the last line", flush=True)
    return {}


def sleep(order, on_progress):
    _tell(order)
    time.sleep(60)


def family(order, on_progress):
    """A child that ignores SIGTERM, one in a session of its own, and a wait."""
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(60)"
    members = [
        subprocess.Popen([sys.executable, "-c", deaf], stdout=subprocess.PIPE, start_new_session=own)
        for own in (False, True)
    ]
    for member in members:
        member.stdout.readline()
    _tell(order, *(member.pid for member in members))
    time.sleep(0 if order.get("leave") else 60)
    return {}


def hold_interpreter(order, on_progress):
    """C code that never gives the interpreter's lock back."""
    _tell(order)
    ctypes.PyDLL(None).sleep(60)


def deaf(order, on_progress):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _tell(order)
    time.sleep(60)


def bomb(order, on_progress):
    hoard = []
    while True:
        hoard.append(bytearray(50_000_000))


def no_threads(order, on_progress):
    threads = [threading.Thread(target=time.sleep, args=(60,), daemon=True) for _ in range(10_000)]
    threading.stack_size(64 << 20)
    for thread in threads:
        thread.start()


def die(order, on_progress):
    os.kill(os.getpid(), order["signal"])
    time.sleep(10)


def leave(order, on_progress):
    os._exit(order["code"])


def close_all(order, on_progress):
    """A library that closes every file, and goes on."""
    _tell(order)
    os.closerange(3, 100)
    time.sleep(60)


def raise_error(order, on_progress):
    import service.errors

    kinds = vars(service.errors) | vars(__import__("builtins"))
    raise kinds[order["kind"]](*order["args"])


def refuse_far(order, on_progress):
    from phrases.phrase import Phrase
    from service.errors import SpecError

    raise SpecError([("stock.x_mm", Phrase("is {how}", how=order["how"]))])


def garbage(order, on_progress):
    """Into every pipe this process has; only that of the words can be written to."""
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):
            if int(file.name) > 2 and "pipe" in str(file.readlink()):
                os.set_blocking(int(file.name), True)
                os.write(int(file.name), b'\xff\x00{"share": NaN}\n[]\n{"share": "x"}\n' + b"[" * 100_000 + b"\n{}\n")
    return {"after": "garbage"}


def chatter(order, on_progress):
    begun = time.monotonic()
    for step in range(order["times"]):
        on_progress(step / order["times"])
    return {"seconds": time.monotonic() - begun, "long": "x" * order["bytes"]}


def _tell(order, *others):
    staging = Path(order["tell"] + ".new")
    staging.write_text(" ".join(map(str, (os.getpid(), *others))))
    staging.replace(order["tell"])
