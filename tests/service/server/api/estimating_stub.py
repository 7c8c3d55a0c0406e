"""Stands in for the process that estimates: does what the name of the picture says, and says the name again, to the
server as the warning of an estimate.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

_ESTIMATE: dict[str, Any] = {
    "relief_mm": 9.0, "max_slope_deg": 27.0, "thickness_ok": True, "throw_ok": True, "smallest_detail_mm": 2.5,
    "passes": [], "planned": False, "exact": True, "hours": 2.0, "blur_mm": 1.2, "psnr_db": None, "seen_db": None,
    "wall": None,
    "blur_by": {"light_mm": 0.0, "milling_mm": 1.2}, "refusals": [], "changes": [], "plans": [],
    "picture": {"width": 8, "height": 8},
}  # fmt: skip


def main() -> None:
    _say({"ready": True})
    for line in sys.stdin:
        asked = json.loads(line)
        name = "prepared" if "prepare" in asked else asked["name"].removesuffix(".png")
        if name == "dies":
            sys.exit(1)
        if name.startswith("takes"):
            time.sleep(float(name.partition(" ")[2]))
        if name == "refused":
            _say({"refused": ["refused: too dark"], "kind": "picture"})
        elif name == "fault":
            _say({"crashed": "IndexError: 7"})
        else:
            _say({"result": _ESTIMATE | {"warnings": [name]} if "spec" in asked else {"name": name}})


def _say(word: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(word) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
