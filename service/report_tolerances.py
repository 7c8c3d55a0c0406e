"""What may be off in the set-up before the picture shows it, in sentences for the person who puts lens and lamp up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from service.report_words import number

_PERCENT = 0.01
_TILT_DEG = 0.5
_NOTHING_DB = 0.1


def tolerance_sentences(tolerances: Mapping[str, Any], *, throw_mm: float) -> list[str]:
    """Distance, tilt and size of the source; empty where nothing was simulated."""
    if not tolerances:
        return []
    return [_distance(tolerances, throw_mm), _tilt(tolerances), *_source(tolerances)]


def _distance(found: Mapping[str, Any], throw_mm: float) -> str:
    near, far = found["focus_range_mm"]
    off_mm = _PERCENT * throw_mm
    worst = min(point["psnr_db"] for point in found["focus"] if abs(abs(point["offset_mm"]) - off_mm) < 1e-3 * off_mm)
    return (
        f"A distance wrong by 1 % ({number(off_mm, 2)} mm) {_costs(found['psnr_db'] - worst)}; 3 dB are lost when the "
        f"wall is {number(-near, 2)} mm too near or {number(far, 2)} mm too far."
    )


def _tilt(found: Mapping[str, Any]) -> str:
    point = min(found["tilts"], key=lambda tilt: abs(tilt["tilt_deg"] - _TILT_DEG))
    moved = (point["shift_mm"][0] ** 2 + point["shift_mm"][1] ** 2) ** 0.5
    return (
        f"Light that comes {number(point['tilt_deg'])}° aslant moves the picture by {number(moved, 2)} mm and "
        f"{_costs(found['psnr_db'] - point['psnr_db'])} beside that."
    )


def _source(found: Mapping[str, Any]) -> Sequence[str]:
    sentences = []
    if found["blur_mm"] > 0:
        sentences.append(
            f"The source that the lens is made for spreads each point over {number(found['blur_mm'], 2)} mm on the "
            f"wall, {number(found['blur_px'], 1)} pixels."
        )
    for point in found["sources"]:
        if found["blur_mm"] == 0 and abs(point["size_deg"] - 0.53) < 1e-9:
            sentences.append(
                f"The sun's disc (0.53°) would spread each point over {number(point['diameter_mm'], 2)} mm, "
                f"{number(point['diameter_px'], 1)} pixels, and leave {point['psnr_db']:.0f} dB; a small lamp far away "
                f"is sharper."
            )
    return sentences


def _costs(lost_db: float) -> str:
    return f"costs {lost_db:.1f} dB" if lost_db >= _NOTHING_DB else "costs next to nothing"
