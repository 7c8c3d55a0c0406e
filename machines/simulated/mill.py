"""The simulated mill: UART, firmware and axes on one clock of simulated seconds, with the faults of a plan.

`advance` carries out what happens up to a time, in order: arrivals, the main loop, motion, timers, faults. Nothing
happens by itself: the holder of the mill (MemoryPort, an endpoint, a test) moves its clock.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from heapq import heappop, heappush
from math import inf

from machines.simulated.controller import Recording
from machines.simulated.faults import Fault, Faults, FaultWire
from machines.simulated.firmware import Firmware
from machines.simulated.serial_side import SerialSide
from machines.simulated.traits import GRBL_11, Traits

_OK = b"ok\r\n"
# So many events without any time between them mean that the model is caught in an endless loop.
MOST_AT_ONCE = 200_000
_CAUSES = ("axes", "main loop", "timer of a line", "realtime byte", "event")
BUTTONS = ("hold", "start", "reset", "door", "close-door", "limit")


class MainLoop:
    """Takes lines from the receive ring when the firmware is not busy.

    due_s : when the line now being parsed is carried out; inf if there is none
    """

    def __init__(self, firmware: Firmware, serial: SerialSide, lines_per_s: float | None) -> None:
        self.due_s = inf
        self._firmware = firmware
        self._serial = serial
        self._parse_s = 1.0 / lines_per_s if lines_per_s else 0.0

    def look_for_line(self, now_s: float) -> None:
        """Begin to parse the next line; if there is none, do a cycle start."""
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


class SimulatedMill:
    """A mill with its controller.

    now_s      : simulated time
    recording  : the path really cut
    firmware   : the controller's internals, for tests
    serial     : UART with its counters (lost_overflow, lost_deaf, most_used)
    connected  : the cable is in; unplug() and replug() change it
    """

    def __init__(
        self,
        traits: Traits = GRBL_11,
        faults: Faults | None = None,
        seed: int = 0,
        *,
        recording: Recording | None = None,
    ) -> None:
        self.traits = traits
        self.faults = faults if faults is not None else Faults()
        self.recording = recording if recording is not None else Recording()
        self.chance = random.Random(seed)
        self.now_s = 0.0
        self.connected = True
        self.cable = 0  # number of unplugs: a port that was opened before one is dead after it
        self.serial = SerialSide(traits.rx_bytes, traits.tx_bytes, crlf_answered_twice=traits.crlf_answered_twice)
        self._off = True
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = 0
        self.firmware = Firmware(
            traits, self.recording, self._say, self._write_eeprom, self._rx_free, self._forget_received
        )
        self._main_loop = MainLoop(self.firmware, self.serial, traits.lines_per_s)
        self._wire = FaultWire(self.faults, self)
        self._boot(first=True)

    # -- the wire --------------------------------------------------------------------------------------------------
    def use_wire(self, byte_s: float) -> None:
        """Set the seconds per byte both ways; 0: no pacing."""
        self.serial.byte_s = byte_s

    def receive(self, data: bytes, at_s: float | None = None) -> None:
        """Take bytes that the host hands to the wire at `at_s` (now)."""
        if not self.connected or not data:
            return
        at_s = self.now_s if at_s is None else at_s
        if self._wire.active:
            self._wire.carry(data, at_s)
        else:
            self.serial.receive(data, at_s)
        self._look_for_line()

    def output(self) -> bytes:
        """Return bytes that have reached the host by now."""
        out = self.serial.out
        parts = []
        while out and out[0][0] <= self.now_s:
            parts.append(out.popleft()[1])
        return b"".join(parts)

    def output_s(self) -> float:
        """Return when the next bytes that are already sent reach the host; inf: none are under way."""
        return self.serial.out[0][0] if self.serial.out else inf

    # -- time ------------------------------------------------------------------------------------------------------
    def next_event_s(self) -> float:
        """Return the time of the next event."""
        queues = (self.serial.realtime, self._events)
        waiting = (queue[0][0] for queue in queues if queue)
        return min(self._main_loop.due_s, self.firmware.stepper.next_s, self.firmware.wake_s(), *waiting)

    def advance(self, to_s: float, *, until_output: bool = False) -> None:
        """Let everything happen up to `to_s`, or up to the moment the next output reaches the host."""
        fw, serial, main_loop = self.firmware, self.serial, self._main_loop
        out, events = serial.out, self._events
        at_once = 0
        while True:
            stepper = fw.stepper
            t = stepper.next_s
            kind = 0
            if main_loop.due_s < t:
                t, kind = main_loop.due_s, 1
            if (fw.task is not None or fw.alarm) and (wake := fw.wake_s()) < t:
                t, kind = wake, 2
            if serial.realtime and serial.realtime[0][0] < t:
                t, kind = serial.realtime[0][0], 3
            if events and events[0][0] < t:
                t, kind = events[0][0], 4
            if until_output and out and out[0][0] <= t and out[0][0] <= to_s:
                self.now_s = fw.now_s = max(self.now_s, out[0][0])
                return
            if t > to_s:
                self.now_s = fw.now_s = max(self.now_s, to_s)
                return
            if t > self.now_s:
                self.now_s = fw.now_s = t
                at_once = 0
            else:
                at_once += 1
                if at_once > MOST_AT_ONCE:
                    raise AssertionError(f"simulated time stands still at {self.now_s:.6f} s ({_CAUSES[kind]})")
            if kind == 0:
                stepper.step()
                if stepper.segments.freed:
                    stepper.segments.freed = False
                    if fw.task is not None:
                        fw.go_on()
                        self._look_for_line()
                if stepper.next_s == inf:
                    fw.go_on()
                    self._look_for_line()
            elif kind == 1:
                main_loop.carry_out_line()
                if fw.task is None:
                    self._look_for_line()
            else:
                if kind == 2:
                    fw.go_on()
                elif kind == 3:
                    byte = heappop(serial.realtime)[2]
                    if not self._off:
                        fw.realtime(byte)
                else:
                    heappop(events)[2]()
                self._look_for_line()

    def call_at(self, when_s: float, what: Callable[[], None]) -> None:
        self._order += 1
        heappush(self._events, (when_s, self._order, what))

    def _look_for_line(self) -> None:
        if not self._off:
            self._main_loop.look_for_line(self.now_s)

    # -- what the firmware asks of the hardware ---------------------------------------------------------------------
    def _say(self, text: str) -> None:
        if not self.connected or self._off:
            return
        data = _OK if text == "ok" else text.encode("latin-1") + b"\r\n"
        if self._wire.active:
            data = self._wire.reply(data)
        if data:
            self.serial.send(data, self.now_s)

    def _write_eeprom(self, seconds: float) -> None:
        self.serial.go_deaf(self.now_s, self.now_s + seconds)

    def _rx_free(self) -> int:
        return self.traits.rx_bytes - self.serial.count_used(self.now_s)

    def _forget_received(self) -> None:
        self._main_loop.forget_received(self.now_s)

    # -- power, cable, buttons -------------------------------------------------------------------------------------
    def power_cycle(self, off_s: float = 1.0) -> None:
        """Switch power off and on: counters start at 0, the tool stays where it is (and loses steps if it moved)."""
        fw = self.firmware
        self._off = True  # sends nothing from here on
        if fw.stepper.moving:
            fw.cut_off(3)
        fw.shift = fw.physical()  # from here on the counters say 0
        fw.position_lost = True
        fw.power_on_state()
        self._forget_received()
        self._boot(first=False, off_s=off_s)

    def pulse_dtr(self) -> None:
        """Do what opening the port does to a board that resets on it."""
        if self.traits.resets_on_open and not self._off:
            self.power_cycle(off_s=0.0)

    def _boot(self, *, first: bool, off_s: float = 0.0) -> None:
        self.call_at(self.now_s + off_s + self.traits.boot_s, lambda: self._finish_boot(first=first))

    def _finish_boot(self, *, first: bool) -> None:
        self.serial.clear_received(self.now_s)
        self._off = False
        fw = self.firmware
        if first and self.traits.damaged_eeprom:
            fw.say("error:7")
        fw.restart(locked=bool(fw.settings[22]))

    def press(self, button: str) -> None:
        """Press a button or switch at the mill: hold, start, reset, door (opens it), close-door, limit."""
        if button not in BUTTONS:
            raise ValueError(f"button '{button}' is unknown; known: {', '.join(BUTTONS)}")
        fw = self.firmware
        fw.now_s = self.now_s
        if button == "close-door":
            fw.pressed.discard("D")
        elif button == "reset":
            fw.reset()
        elif fw.critical or fw.alarm:
            return
        elif button == "hold":
            fw.hold()
        elif button == "start":
            fw.resume()
        elif button == "door":
            fw.open_door()
        elif button == "limit" and fw.settings[21] and fw.state not in ("Alarm", "Home"):
            fw.task = None
            fw.cut_off(1)
        self._look_for_line()

    def unplug(self) -> None:
        """Pull the cable: the mill goes on with what it holds."""
        if self.connected:
            self.connected = False
            self.cable += 1
            self.serial.cut_wire(self.now_s)
            if self.serial.next_line_s() == inf:
                self._main_loop.due_s = inf
            self._look_for_line()

    def replug(self) -> None:
        self.connected = True

    @property
    def physical_mm(self) -> tuple[float, float, float]:
        """Where the tool really is, in the coordinates of the recording."""
        return self.firmware.physical()

    # -- faults of the plan ----------------------------------------------------------------------------------------
    def arm(self, faults: Faults) -> None:
        """Put a new plan in place of the old one; its bytes, lines and replies are counted from now."""
        self.faults = faults
        self._wire = FaultWire(faults, self)

    def carry_out(self, fault: Fault, byte: int) -> None:
        """Carry out a fault at the mill itself, now."""
        fw = self.firmware
        self._wire.note(fault, byte)
        if fault.kind == "disconnect":
            self.unplug()
            if fault.length_s:
                self.call_at(self.now_s + fault.length_s, self.replug)
        elif fault.kind == "power-cycle":
            self.power_cycle(fault.length_s or 1.0)
        elif fault.kind == "eeprom-stall":
            self._write_eeprom(fault.length_s or 0.02)
        elif fault.kind == "door":
            self.press("door")
            self.call_at(self.now_s + (fault.length_s or 3.0), lambda: self.press("close-door"))
        else:
            self.press(fault.kind.removesuffix("-button"))
        fw.go_on()
