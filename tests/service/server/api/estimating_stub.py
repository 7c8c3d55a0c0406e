"""Stands in for the process that estimates: does what the name of the picture says."""

from __future__ import annotations

import json
import sys
import time


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
            _say({"fault": "IndexError: 7"})
        else:
            _say({"estimate": {"name": name}})


def _say(word: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(word) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
