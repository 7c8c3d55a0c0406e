"""GRBL 1.1, grblHAL and FluidNC: no `%`, no tool change, no tool compensation; lines below 80 characters that end in a
line feed. What a tool-length probe has set (G43.1) is left as it is: Z0 was set with it."""

from __future__ import annotations

from dataclasses import replace

from cam.posts.post import Post

GRBL = Post(
    name="grbl",
    suffix=".nc",
    start=("G21G90G94G17{offset}",),
    zero="zero: {offset}, with G92 and tool length G43.1 as they were when it was set",
    spin=("M3S{rpm}", "G4P{dwell_s}"),
    end=("M5", "M2"),
    coolant={"air": "M8", "mist": "M7", "flood": "M8"},  # stock GRBL has one output, M8, and M7 only where built in
)
GRBLHAL = replace(GRBL, name="grblhal")
FLUIDNC = replace(GRBL, name="fluidnc")
GRBL_FAMILY = (GRBL, GRBLHAL, FLUIDNC)
