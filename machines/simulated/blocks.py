"""Executes one block of G-code in GRBL's order: each function is a task that yields what it waits for."""

from __future__ import annotations

from machines.simulated import reports
from machines.simulated.controller import EMPTY, NEVER, ROOM, Controller, Task, find_contact, is_touching
from machines.simulated.interpreter import ZERO, Action, SimulatedMove, Triple, chords
from machines.simulated.interruptions import apply_overrides, raise_alarm


def carry_out_gcode(fw: Controller, code: bytes) -> Task:
    """Check and execute one block, in GRBL's order."""
    action = fw.interpreter.read(code)
    if action.line_number is not None and fw.traits.line_numbers:
        fw.line = action.line_number
    dry = fw.state == "Check"
    state = fw.interpreter
    state.feed = action.feed
    if action.spindle_rpm != state.spindle_rpm:
        if state.modal["spindle"] != "M5" and not dry:
            yield EMPTY
        state.spindle_rpm = action.spindle_rpm
        fw.spindle_rpm = action.spindle_rpm
    if action.tool is not None:
        state.tool = action.tool
    yield from _switch_accessories(fw, action, dry=dry)
    if action.dwell_s is not None and not dry:
        yield EMPTY
        yield fw.now_s + action.dwell_s
    old_wcs = state.modal["wcs"]
    if action.words.axis_command == "tool-length" or action.modal["wcs"] != old_wcs or action.words.non_modal:
        yield from _change_offsets(fw, action, dry=dry)
    state.modal = action.modal
    state.refresh()
    if action.move is not None:
        yield from _move(fw, action.move)
    if action.stored is not None:
        yield from _move(fw, SimulatedMove("G0", action.stored, 0.0, 0.0))
    yield from _control_flow(fw, action.words.commands.get("flow", ""), dry=dry)


def _switch_accessories(fw: Controller, action: Action, *, dry: bool) -> Task:
    """Switch spindle and coolant: a change waits for the buffer to run empty."""
    state = fw.interpreter
    if action.modal["spindle"] != state.modal["spindle"]:
        if not dry:
            yield EMPTY
            fw.spindle = action.modal["spindle"]
            fw.spindle_rpm = state.spindle_rpm
            fw.ov_in = 0
        state.modal["spindle"] = action.modal["spindle"]
    wanted = action.words.commands.get("coolant")
    if wanted is not None:
        coolant = set() if wanted == "M9" else state.coolant | {wanted}
        if coolant != state.coolant:
            if not dry:
                yield EMPTY
                fw.ov_in = 0
            state.coolant = coolant


def _change_offsets(fw: Controller, action: Action, *, dry: bool) -> Task:
    """Change offsets once the buffer is empty; those in the EEPROM shut the receiver meanwhile."""
    state, command = fw.interpreter, action.words.non_modal
    if command == "G53" or (command in ("G4", "G28", "G30") and action.modal["wcs"] == state.modal["wcs"]):
        return
    if not dry:
        yield EMPTY
    if command == "G10" and action.offsets is not None:
        yield from eeprom(fw, 3 * fw.traits.eeprom_write_s)
        state.stored[action.system] = action.offsets
    elif command in ("G28.1", "G30.1"):
        yield from eeprom(fw, 3 * fw.traits.eeprom_write_s)
        state.stored[command[:3]] = state.position
    elif command == "G92" and action.offsets is not None:
        state.g92 = action.offsets
    elif command == "G92.1":
        state.g92 = ZERO
    elif action.words.axis_command == "tool-length" and action.offsets is not None:
        state.tool_length = action.offsets[2]
    fw.wco_in = 0


def eeprom(fw: Controller, seconds: float) -> Task:
    if seconds > 0.0:
        fw.write_eeprom(seconds)
        yield fw.now_s + seconds


def _control_flow(fw: Controller, command: str, *, dry: bool) -> Task:
    if command in ("", "M1"):
        return
    if not dry:
        yield EMPTY
    if command == "M0":
        if not dry:
            fw.state, fw.held = "Hold", True
            yield 0.0
        return
    state = fw.interpreter
    state.modal.update({"motion": "G1", "plane": "G17", "distance": "G90", "feed-mode": "G94", "wcs": "G54"})
    state.modal["spindle"] = "M5"
    state.coolant.clear()
    state.refresh()
    if not dry:
        fw.feed_percent = fw.rapid_percent = fw.spindle_percent = 100
        apply_overrides(fw)
        fw.spindle = "M5"
        fw.wco_in = fw.ov_in = 0
    fw.say("[MSG:Pgm End]")


def _move(fw: Controller, move: SimulatedMove) -> Task:
    if move.motion.startswith("G38"):
        yield from _run_probe(fw, move)
        return
    rapid = move.motion == "G0"
    points = [move.target] if move.arc is None else list(chords(move.arc, fw.settings[12]))
    speed = move.speed
    last = fw.interpreter.position
    for point in points:
        if move.inverse_time and not rapid:
            length = sum((a - b) ** 2 for a, b in zip(point, last, strict=True)) ** 0.5
            speed = length * len(points) * move.speed
        last = point
        yield from plan(fw, point, speed, rapid=rapid, feed=move.feed)
    fw.interpreter.position = move.target


def plan(fw: Controller, point: Triple, speed: float, *, rapid: bool, feed: float, kind: str = "program") -> Task:
    """Plan a move as mc_line: soft limits, room, planner."""
    if fw.settings[20] and fw.state != "Jog" and is_out_of_travel(fw, point):
        yield from _raise_soft_limit(fw)
    if fw.state == "Check":
        return
    yield ROOM
    fw.stepper.planner.add(*point, speed, rapid, feed=feed, line=fw.line, kind=kind)
    if fw.stepper.moving:
        fw.stepper.segments.fill()


def is_out_of_travel(fw: Controller, point: Triple) -> bool:
    travel = fw.settings
    return any(not -travel[130 + i] - 1e-6 <= p <= 1e-6 for i, p in enumerate(point))


def _raise_soft_limit(fw: Controller) -> Task:
    """Stop in good order, then ALARM:2; the line that caused it is never answered."""
    if fw.state == "Run":
        fw.soft_limit = True
        fw.state, fw.held = "Hold", False
        fw.stepper.hold()
    else:
        raise_alarm(fw, 2)
    yield NEVER


def _run_probe(fw: Controller, move: SimulatedMove) -> Task:
    """Probe straight. The contact ends the move at once (the real one overshoots by its braking distance)."""
    if fw.state == "Check":
        fw.interpreter.position = move.target
        return
    yield EMPTY
    towards, strict = move.motion in ("G38.2", "G38.3"), move.motion in ("G38.2", "G38.4")
    if is_touching(fw.traits, fw.physical()) == towards:
        fw.probe_found = False
        raise_alarm(fw, 4)
        yield 0.0
        return
    contact = find_contact(fw.traits, fw.interpreter.position, move.target, shift_mm=fw.shift)
    end, found = contact or move.target, contact is not None
    fw.stepper.planner.add(*end, move.speed, False, feed=move.feed, line=fw.line, kind="probe")
    yield EMPTY
    fw.interpreter.position = (fw.stepper.x, fw.stepper.y, fw.stepper.z)
    fw.probe_found = found
    fw.probed = fw.interpreter.position if found else ZERO
    if strict and not found:
        raise_alarm(fw, 5)
        yield 0.0
    fw.say(f"[PRB:{reports.xyz(fw, fw.probed)}:{int(found)}]")
