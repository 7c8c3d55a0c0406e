"""What the task of a line can wait for."""

from __future__ import annotations

from collections.abc import Generator

# A number is a time to wait until.
ROOM, EMPTY, NEVER = "room in the planner", "an empty buffer", "a reset"
Task = Generator[str | float, None, None]
