"""What the setup sheet says of the picture as milled, in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from service.report_words import number

CAUSES = {
    "scallops": "the grooves between rows: a finer pitch or a bigger ball",
    "steps": "the machine's steps: a machine with finer ones, or a bigger pitch that asks for longer moves",
    "noise": "height errors of the machine from row to row: a stiffer set-up, or one unbroken path",
    "rounding": "the decimals of the program: a dialect with more of them",
}
_WORTH_DB = 0.3


def milled_sentences(milled: Mapping[str, Any]) -> list[str]:
    """From report `as_milled`; nothing where there is none."""
    if milled.get("psnr_db") is None:
        return []
    sentences = [_expected(milled), _blur(milled)]
    gains = milled.get("gain_db_without") or {}
    cause = max(gains, key=lambda name: gains[name], default=None)
    if cause is not None and gains[cause] >= _WORTH_DB:
        sentences.append(f"What costs most is {CAUSES[cause]} ({gains[cause]:.1f} dB would be won without it).")
    return sentences


def detail_lost(milled: Mapping[str, Any], *, planned: bool = False) -> str | None:
    """A warning where the milled surface blurs more than a pixel. planned: the planner chose the passes, for a goal."""
    pixels = math.hypot(milled["blur_x_px"], milled["blur_y_px"])
    if not pixels > 1.0:
        return None
    seen = f"the tool's marks blur the picture by {pixels:.1f} pixels (rms): "
    if planned:
        return f"{seen}its finer detail will not be seen with the passes planned for this goal"
    told = "the preset `recommended` plans those that show most on this mill"
    return f"{seen}these passes cannot show its finer detail; {told}"


def _expected(milled: Mapping[str, Any]) -> str:
    designed, seen = milled.get("psnr_db_designed"), milled["psnr_db"]
    told = f"Expect {seen:.1f} dB from the milled surface as it comes from the machine"
    return f"{told}, where the lens as designed has {designed:.1f} dB." if designed is not None else f"{told}."


def _blur(milled: Mapping[str, Any]) -> str:
    step_um, noise_um = (number(1000 * milled[name], 2) for name in ("step_mm", "z_noise_mm"))
    machine = f"steps of {step_um} µm and height errors of {noise_um} µm"
    return (
        f"Its slopes are off by {milled['slope_rms_mrad']:.1f} mrad rms, which blurs the picture by "
        f"{milled['blur_x_px']:.1f} pixels in X and {milled['blur_y_px']:.1f} in Y (rms; with {machine}). "
        "Polishing takes off grooves, and with them this blur."
    )
