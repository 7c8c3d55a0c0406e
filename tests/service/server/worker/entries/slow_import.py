"""An entry whose import takes for ever; it tells its process number in the data folder of the settings."""

from __future__ import annotations

import os
import time
from pathlib import Path

folder = Path(os.environ["CAUSTICMILL_DATA"])
(folder / "importing.new").write_text(str(os.getpid()))
(folder / "importing.new").replace(folder / "importing")
time.sleep(60)
