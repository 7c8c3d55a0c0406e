"""The firmware's main loop: one line after the other, each as long as its parsing takes."""

from __future__ import annotations

from math import inf

from machines.simulated.firmware import Firmware
from machines.simulated.serial_side import SerialSide


class MainLoop:
    """Takes lines from the receive ring where the firmware is not busy.

    due_s : when the line now being parsed is carried out; inf where there is none
    """

    def __init__(self, firmware: Firmware, serial: SerialSide, lines_per_s: float | None) -> None:
        self.due_s = inf
        self._firmware = firmware
        self._serial = serial
        self._parse_s = 1.0 / lines_per_s if lines_per_s else 0.0

    def look_for_line(self, now_s: float) -> None:
        """Begin to parse the next line, or with nothing to read, cycle start."""
        fw, serial = self._firmware, self._serial
        if self.due_s != inf or fw.task is not None or fw.busy():
            return
        serial.admit(now_s)
        free_s = serial.may_go_on_s()
        if free_s < now_s:
            free_s = now_s
        line_s = serial.next_line_s()
        if line_s > now_s:
            fw.start_cycle()
            if line_s == inf:
                return
        self.due_s = (line_s if line_s > free_s else free_s) + self._parse_s

    def carry_out_line(self) -> None:
        self.due_s = inf
        self._firmware.take_line(self._serial.take_line())

    def forget_received(self, now_s: float) -> None:
        """Forget what was received and not carried out, as in a reset or without power."""
        self._serial.clear_received(now_s)
        self.due_s = inf
