"""A process in the place of the one that starts agents: its agent is on its own, as ours are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

agent = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"], start_new_session=True)
Path(os.environ["CAUSTICMILL_DATA"], "agent.pid").write_text(str(agent.pid))
agent.returncode = 0  # it is not ours to wait for
