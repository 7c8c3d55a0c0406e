"""Traits of the simulated controller: firmware, buffer sizes, speeds, and traps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

Triple = tuple[float, float, float]

# $-settings of a small router (rates in mm/min, accelerations in mm/s2), as `$$` lists them.
DEFAULT_SETTINGS: Mapping[int, float] = {
    0: 10, 1: 25, 2: 0, 3: 0, 4: 0, 5: 0, 6: 0, 10: 1, 11: 0.01, 12: 0.002, 13: 0, 20: 0, 21: 0, 22: 0, 23: 0,
    24: 25, 25: 500, 26: 250, 27: 1, 30: 24000, 31: 0, 32: 0,
    100: 250, 101: 250, 102: 250, 110: 5000, 111: 5000, 112: 1500,
    120: 400, 121: 400, 122: 200, 130: 300, 131: 300, 132: 80,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CornerPlate:
    """A plate on the front left corner of a block, unbounded to the right, backwards and down; and the tool that
    touches it.

    left_mm, front_mm : physical X and Y of the faces that are touched from the left and from the front
    tool_radius_mm    : of the cylinder that touches them
    """

    left_mm: float
    front_mm: float
    tool_radius_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Traits:
    """One controller with its traps.

    rx_bytes               : bytes the receive ring holds; one more is dropped
    rx_advertised          : the size that `$I` reports
    tx_bytes               : bytes the firmware can queue to be sent before its main loop waits
    line_chars             : code characters a line may have; one more is error:11
    planner_blocks         : usable slots of the planner
    segments               : slots of the segment buffer, each at most `segment_s` of motion
    lines_per_s            : lines the parser takes in a second; None: no time at all
    crlf_answered_twice    : "\\r\\n" is a line and an empty line
    echo                   : every line comes back as [echo: ...] before it is planned
    line_numbers           : firmware built with N words reported as Ln:
    homing                 : $22 at power-up (None: as in `settings`); with it power-up is locked
    damaged_eeprom         : the first start answers error:7 before its banner and restores defaults
    eeprom_write_s         : how long a `$x=` shuts the receiver; work offsets take three times that
    resets_on_open         : DTR pulse at opening restarts it, as an Arduino does
    mist                   : built with M7 ($I tells it by the letter M); stock 1.1 is not
    alarm_delay_s          : how long the program stands still behind each ALARM: line
    homing_alarm           : a homing cycle ends in this alarm (8, 9 or 10) after its first search; 0: it does not
    reports_when_critical  : `?` is answered in an alarm that waits for a reset (1.1: no)
    idle_with_blocks_at    : after this many executed blocks the stepper runs dry once and it stands Idle with blocks
    percent_allowed        : a line "%" is taken (grblHAL, FluidNC)
    power_up_machine_mm    : where the tool stands at power-up, in coordinates a homing cycle would find
    reset_slip_mm          : steps lost, as a distance along the motion, when motion is cut off without deceleration
    probe_surface_mm       : physical Z of the surface a probe touches; None: it touches none
    corner_plate           : the plate at which that surface ends, and can be touched from the left and from the front;
                             None: no plate
    """

    firmware: str = "grbl"
    banner: str = "Grbl 1.1h ['$' for help]"
    version: tuple[str, ...] = ("[VER:1.1h.20190830:]",)
    option_letters: str = "V"
    baud: int = 115200
    rx_bytes: int = 128
    rx_advertised: int = 128
    tx_bytes: int = 104
    line_chars: int = 79
    planner_blocks: int = 15
    segments: int = 5
    segment_s: float = 0.01
    lines_per_s: float | None = 1000.0
    crlf_answered_twice: bool = True
    echo: bool = False
    line_numbers: bool = False
    mist: bool = False
    homing: bool | None = None
    damaged_eeprom: bool = False
    eeprom_write_s: float = 0.015
    boot_s: float = 0.5
    resets_on_open: bool = False
    alarm_delay_s: float = 0.5
    homing_alarm: int = 0
    reports_when_critical: bool = False
    idle_with_blocks_at: int | None = None
    percent_allowed: bool = False
    power_up_machine_mm: Triple = (-200.0, -150.0, -10.0)
    reset_slip_mm: float = 0.07
    probe_surface_mm: float | None = -5.0
    corner_plate: CornerPlate | None = None
    settings: Mapping[int, float] = field(default_factory=dict)

    def all_settings(self) -> dict[int, float]:
        """Return $-settings at power-up."""
        settings = {**DEFAULT_SETTINGS, **self.settings}
        if self.homing is not None:
            settings[22] = float(self.homing)
        return settings

    def with_settings(self, settings: Mapping[int, float]) -> Traits:
        return replace(self, settings={**self.settings, **settings})


GRBL_11 = Traits()
GRBL_11_ECHO = replace(GRBL_11, echo=True)
GRBLHAL = replace(
    GRBL_11,
    firmware="grblhal",
    banner="GrblHAL 1.1f ['$' or '$HELP' for help]",
    version=("[VER:1.1f.20240115:]",),
    option_letters="VNMSL",
    rx_bytes=1023,
    rx_advertised=1024,
    tx_bytes=1023,
    line_chars=255,
    planner_blocks=100,
    segments=9,
    lines_per_s=10000.0,
    crlf_answered_twice=False,
    eeprom_write_s=0.0,
    mist=True,
    alarm_delay_s=0.1,
    reports_when_critical=True,
    percent_allowed=True,
)
FLUIDNC = replace(
    GRBLHAL,
    firmware="fluidnc",
    banner="Grbl 3.7 [FluidNC v3.7.17 (wifi) '$' for help]",
    version=("[VER:3.7 FluidNC v3.7.17:]",),
    option_letters="PHSW",
    rx_bytes=255,
    rx_advertised=255,
    tx_bytes=4096,
    planner_blocks=15,
    segments=12,
)
PRESETS: Mapping[str, Traits] = {
    "grbl11": GRBL_11,
    "grbl11-echo": GRBL_11_ECHO,
    "grblhal": GRBLHAL,
    "fluidnc": FLUIDNC,
}
