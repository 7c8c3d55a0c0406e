"""A mill that exists only in simulated time: a GRBL-like controller with the traps of the real one, and its ports."""

from machines.simulated.controller import CutSegment, Recording
from machines.simulated.endpoints import Endpoint, MemoryPort, serve_pty, serve_tcp
from machines.simulated.faults import KINDS, Fault, FaultDone, Faults, parse_fault
from machines.simulated.mill import SimulatedMill
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, PRESETS, CornerPlate, Traits

__all__ = [
    "FLUIDNC",
    "GRBLHAL",
    "GRBL_11",
    "GRBL_11_ECHO",
    "KINDS",
    "PRESETS",
    "CornerPlate",
    "CutSegment",
    "Endpoint",
    "Fault",
    "FaultDone",
    "Faults",
    "MemoryPort",
    "Recording",
    "SimulatedMill",
    "Traits",
    "parse_fault",
    "serve_pty",
    "serve_tcp",
]
