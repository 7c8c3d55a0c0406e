"""GRBL 1.1: no `%`, no tool change, no tool compensation; lines below 80 characters that end in a line feed."""

from __future__ import annotations

from cam.posts.post import Post

GRBL = Post(
    name="grbl",
    suffix=".nc",
    start=("G21G90G94G17G54", "G0Z{safe_z}", "M3S{rpm}", "G4P{dwell_s}"),
    end=("G0Z{safe_z}", "M5", "M2"),
)
