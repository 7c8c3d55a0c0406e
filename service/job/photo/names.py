"""The pictures of a job that a photograph is compared with, the best first; apart, so that no arrays are imported."""

from __future__ import annotations

from typing import Literal

Kind = Literal["finished", "milled", "designed"]
FORETOLD: dict[Kind, str] = {"finished": "caustic-as-finished.png", "milled": "caustic-as-milled.png"}
