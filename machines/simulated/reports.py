"""What the firmware writes: banner, status report, settings, offsets, parser state."""

from __future__ import annotations

from collections.abc import Iterable

from machines.simulated.controller import Controller

_IDLE_EVERY = 10  # reports between two WCO or Ov fields while standing
_WCO_BUSY_EVERY = 30
_OV_BUSY_EVERY = 20
_BUSY = ("Home", "Run", "Hold", "Jog", "Door")


INCH_MM = 25.4


def xyz(fw: Controller, values: Iterable[float]) -> str:
    """Return lengths as reported: mm with three decimals, with $13 inch with four."""
    unit_mm, digits = (INCH_MM, 4) if fw.settings[13] else (1.0, 3)
    return ",".join(f"{(0.0 if abs(v) < 0.5 * unit_mm * 10.0**-digits else v / unit_mm):.{digits}f}" for v in values)


def rate(fw: Controller, mm_per_min: float) -> float:
    return mm_per_min / INCH_MM if fw.settings[13] else mm_per_min


def status_report(fw: Controller) -> str:
    """Return the answer to `?`."""
    settings, state = int(fw.settings[10]), fw.state_word()
    at = fw.stepper.where(fw.now_s)
    offset = fw.interpreter.offset
    if settings & 1:
        fields = [state, f"MPos:{xyz(fw, at)}"]
    else:
        fields = [state, f"WPos:{xyz(fw, (p - o for p, o in zip(at, offset, strict=True)))}"]
    if settings & 2:
        free = max(0, fw.traits.planner_blocks - len(fw.stepper.planner.blocks))
        fields.append(f"Bf:{free},{fw.rx_free()}")
    if fw.traits.line_numbers and (block := fw.stepper.executing_block) is not None:
        fields.append(f"Ln:{block.line}")
    fields.append(f"FS:{rate(fw, fw.stepper.speed * 60):.0f},{fw.spindle_now():.0f}")
    if pins := fw.pins():
        fields.append(f"Pn:{pins}")
    fields += _take_rare_fields(fw, offset)
    return f"<{'|'.join(fields)}>"


def _take_rare_fields(fw: Controller, offset: tuple[float, float, float]) -> list[str]:
    busy = fw.state in _BUSY
    if fw.wco_in > 0:
        fw.wco_in -= 1
    else:
        fw.wco_in = (_WCO_BUSY_EVERY if busy else _IDLE_EVERY) - 1
        fw.ov_in = max(fw.ov_in, 1)  # never both in one report
        return [f"WCO:{xyz(fw, offset)}"]
    if fw.ov_in > 0:
        fw.ov_in -= 1
        return []
    fw.ov_in = (_OV_BUSY_EVERY if busy else _IDLE_EVERY) - 1
    fields = [f"Ov:{fw.feed_percent},{fw.rapid_percent},{fw.spindle_percent}"]
    spindle = {"M3": "S", "M4": "C"}.get(fw.spindle if fw.spindle_on() else "M5", "")
    coolant = "".join(letter for name, letter in (("M8", "F"), ("M7", "M")) if name in fw.interpreter.coolant)
    if spindle or coolant:
        fields.append(f"A:{spindle}{coolant}")
    return fields


def settings_lines(fw: Controller) -> list[str]:
    return [f"${k}={_format_setting(k, v)}" for k, v in sorted(fw.settings.items())]


def _format_setting(number: int, value: float) -> str:
    return f"{value:.3f}" if number in (11, 12, 24, 25, 27) or number >= 100 else f"{value:.0f}"


def offsets_lines(fw: Controller) -> list[str]:
    state = fw.interpreter
    lines = [f"[{name}:{xyz(fw, value)}]" for name, value in state.stored.items()]
    lines.append(f"[G92:{xyz(fw, state.g92)}]")
    lines.append(f"[TLO:{xyz(fw, (state.tool_length,))}]")
    lines.append(f"[PRB:{xyz(fw, fw.probed)}:{int(fw.probe_found)}]")
    return lines


def parser_state(fw: Controller) -> str:
    s = fw.interpreter
    m = s.modal
    words = [m["motion"], m["wcs"], m["plane"], m["units"], m["distance"], m["feed-mode"], m["spindle"]]
    words += [c for c in ("M7", "M8") if c in s.coolant] or ["M9"]
    feed = s.feed / 25.4 if m["units"] == "G20" else s.feed
    return f"[GC:{' '.join(words)} T{s.tool} F{feed:.1f} S{s.spindle_rpm:.0f}]".replace(".0 S", " S")


def build_info(fw: Controller) -> list[str]:
    t = fw.traits
    asked = (("N", t.line_numbers), ("M", t.mist))
    letters = t.option_letters + "".join(a for a, built_in in asked if built_in and a not in t.option_letters)
    return [*t.version, f"[OPT:{letters},{t.planner_blocks},{t.rx_advertised}]"]
