"""What the setup sheet says of the picture as milled, in sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from phrases.phrase import Phrase
from service.wording import number, psnr_in_words

CAUSES = {
    "scallops": ("the grooves between rows", "a finer pitch or a bigger ball leaves less of them"),
    "steps": ("the machine's steps", "a machine with finer ones, or a bigger pitch that asks for longer moves, helps"),
    "noise": ("height errors of the machine from row to row", "a stiffer set-up, or one unbroken path, helps"),
    "rounding": ("the decimals of the program", "a dialect with more of them helps"),
}
_WORTH_DB = 0.3
UNSEEN_DB = 40.0  # of what blur does to a picture that has no finer detail than that
_MOST_OF_IT = 0.7  # of what milling costs, from which one cause explains it


def sentences_as_milled(milled: Mapping[str, Any]) -> list[str]:
    """Return sentences from report `as_milled`; nothing where there is none."""
    if milled.get("psnr_db") is None:
        return []
    return [_word_expectation(milled), *_main_cause(milled), _blur(milled)]


def _main_cause(milled: Mapping[str, Any]) -> list[str]:
    """Return what costs most. Marks hide each other: where one is taken away the others stay, so that what each alone
    would bring does not add up to what all of them cost.
    """
    gains = sorted((milled.get("gain_db_without") or {}).items(), key=lambda row: -row[1])
    if not gains or gains[0][1] < _WORTH_DB:
        return []
    gain, (what, less) = gains[0][1], CAUSES[gains[0][0]]
    lost = (milled.get("psnr_db_designed") or milled["psnr_db"]) - milled["psnr_db"]
    if lost <= 0 or gain >= _MOST_OF_IT * lost:
        return [f"Most of the loss comes from {what} ({gain:.1f} dB would be won without them): {less}."]
    others = [CAUSES[name][0] for name, _ in gains[1:2]]
    first = f", {others[0]} first," if others else ""
    return [
        f"Of the {lost:.1f} dB that milling costs, the largest part are {what} ({less}); but without them alone only "
        f"{gain:.1f} dB come back: the other marks{first} then hide as much."
    ]


def detail_lost(milled: Mapping[str, Any], *, planned: bool = False) -> Phrase | None:
    """Return a warning where the milled surface blurs more than a pixel, of a picture with detail so fine.

    planned : the planner chose the passes, for a goal
    """
    pixels = math.hypot(milled["blur_x_px"], milled["blur_y_px"])
    if not pixels > 1.0 or milled.get("psnr_db_blurred", 0.0) > UNSEEN_DB:
        return None
    if planned:
        return Phrase(
            "the picture's fine detail will not be seen with the passes planned for this goal: a larger lens shows "
            "more (the tool's marks blur it by {blur_px:.1f} of its pixels)",
            blur_px=pixels,
        )
    return Phrase(
        "the picture's fine detail will not be seen: “Recommended” plans the passes that show most on this mill, and a "
        "larger lens shows more (the tool's marks blur it by {blur_px:.1f} of its pixels)",
        blur_px=pixels,
    )


def _word_expectation(milled: Mapping[str, Any]) -> str:
    designed, seen = milled.get("psnr_db_designed"), milled["psnr_db"]
    given = (milled.get("against_original") or {}).get("psnr_db", seen)  # a person compares with the picture as given
    told = f"As the block comes from the machine ({given:.1f} dB): {psnr_in_words(given)}"
    if designed is None:
        return f"{told}."
    if designed < seen:
        return f"{told}. Do not polish it: the lens is made for these marks, and shows {designed:.1f} dB without them."
    return f"{told}. Polished until no groove is left ({designed:.1f} dB): {psnr_in_words(designed)}."


def _blur(milled: Mapping[str, Any]) -> str:
    step_um, noise_um = (number(1000 * milled[name], 2) for name in ("step_mm", "z_noise_mm"))
    machine = f"steps of {step_um} µm and height errors of {noise_um} µm"
    slopes = milled["slope_rms_mrad"]
    return (
        f"For experts: its slopes are off by {slopes:.1f} µm per mm ({slopes:.1f} mrad) rms, which blurs the picture "
        f"by {milled['blur_x_px']:.1f} pixels in X and {milled['blur_y_px']:.1f} in Y (rms; with {machine})."
    )
