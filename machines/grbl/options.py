"""What of a GRBL link can be set: how often it is asked, its buffer, and how far off its path is still on it."""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_RX_BYTES = 128  # GRBL 1.1 on an Uno, the smallest in the field; FluidNC's $I does not say


@dataclass(frozen=True, slots=True, kw_only=True)
class GrblOptions:
    """How a link to a GRBL controller is used.

    poll_s, run_poll_s : between status requests, and while a program runs
    rx_bytes           : receive buffer; None asks $I, and takes DEFAULT_RX_BYTES where that does not say
    corridor_mm        : how far a reported position may be off the programmed path, on top of rounding, steps and arc
                         chords ($12)
    identify_s         : until a port on which nothing like a controller answers is given up
    """

    poll_s: float = 0.2
    run_poll_s: float = 0.1
    rx_bytes: int | None = None
    corridor_mm: float = 0.010
    identify_s: float = 6.0
    dialect: str = "grbl"
