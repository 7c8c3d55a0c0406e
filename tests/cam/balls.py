"""Ball end mills for plans in tests."""

from __future__ import annotations

from dataclasses import replace

from cam.tools import Tool


def tool(radius_mm: float, **changes: object) -> Tool:
    usual = Tool(
        name=f"r{radius_mm:g}", radius_mm=radius_mm, flutes=2, flute_length_mm=20.0, shank_radius_mm=radius_mm,
        stick_out_mm=30.0, max_rpm=30_000, cost_class=1,
    )  # fmt: skip
    return replace(usual, **changes)  # type: ignore[arg-type]
