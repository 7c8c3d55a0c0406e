"""A process that serves tickets, to be killed. Arguments: executor, folder for its notes, executors to take over.

A ticket's body notes that it begins; one called "slow..." waits for the file "release" before it notes that it ends;
one called "fenced..." is fenced the first time; one called "busy..." finds no slot at executor "a".
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from service.server.queue.dbos import DbosEngine
from service.server.queue.engine import Busy, Fenced, Ticket
from service.settings import ServerSettings

executor, folder, dead = sys.argv[1], Path(sys.argv[2]), sys.argv[3:]


def note(word: str, ticket: Ticket) -> None:
    with (folder / "notes").open("a") as file:
        file.write(f"{word} {ticket.text} {executor}\n")


def body(ticket: Ticket) -> None:
    note("begin", ticket)
    if ticket.job_id.startswith("fenced") and not (folder / "fenced").exists():
        (folder / "fenced").touch()
        raise Fenced("not now")
    if ticket.job_id.startswith("busy") and executor == "a":
        raise Busy
    while ticket.job_id.startswith("slow") and not (folder / "release").exists():
        time.sleep(0.02)
    note("end", ticket)


engine = DbosEngine(ServerSettings.load())
engine.serve(body, executor=executor, slots=1)
print("ready", flush=True)
while os.getppid() != 1:
    engine.take_over(dead)
    engine.pick_up()
    time.sleep(0.05)
