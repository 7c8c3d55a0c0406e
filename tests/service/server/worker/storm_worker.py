"""The real worker with stand-ins for the stages' work, to be killed."""

from __future__ import annotations

import sys

from service.server.worker.main import main

sys.exit(main(entry="storm_stages:run"))
