"""A worker to be killed: runs one stage, prints how it ended. Arguments: data folder, order (JSON), lease, entry."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from service.server.worker.stage_process import StageProcesses
from service.settings import ServerSettings

settings = ServerSettings.load(data=Path(sys.argv[1]), lease_s=float(sys.argv[3]))
processes = StageProcesses(settings, entry=sys.argv[4])
end = processes.run(
    json.loads(sys.argv[2]), log=settings.data / "stage.log", on_progress=lambda _: None, stop=lambda: None
)
print(end, flush=True)
