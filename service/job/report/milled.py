"""The setup sheet's sentences on the picture as milled."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from phrases.phrase import Phrase
from service.wording import likeness_in_words, number

CAUSES = {
    "scallops": (Phrase("the grooves between rows"), Phrase("a finer pitch or a bigger ball leaves less of them")),
    "steps": (
        Phrase("the machine's steps"),
        Phrase("a machine with finer ones, or a bigger pitch, which asks for longer moves, helps"),
    ),
    "noise": (
        Phrase("height errors of the machine from row to row"),
        Phrase("a stiffer set-up, or one unbroken path, helps"),
    ),
    "screws": (
        Phrase("the machine's screws"),
        Phrase("better screws, or axes with linear encoders, help"),
    ),
    "haze": (Phrase("the haze of the block"), Phrase("a clearer block, or a better polish of both sides, helps")),
    "back": (
        Phrase("the waves of the block's back"),
        Phrase("a block whose back is flatter, or faced and polished flat, helps"),
    ),
    "rounding": (Phrase("the decimals of the program"), Phrase("a dialect with more of them helps")),
}
_WORTH_DB = 0.3
UNSEEN_DB = 40.0  # loss by blur of a picture without finer detail: not visible above this
_MOST_OF_IT = 0.7  # share of the loss by milling from which a single cause explains it


def sentences_as_milled(milled: Mapping[str, Any], *, finished: bool) -> list[Phrase]:
    """Return sentences from report `as_milled`; empty if there is none. finished: the lens is to be, by hand."""
    if milled.get("psnr_db") is None:
        return []
    return [_describe_expectation(milled, finished=finished), *_main_cause(milled), _blur(milled)]


def _main_cause(milled: Mapping[str, Any]) -> list[Phrase]:
    """Return the cause that costs most. Marks hide each other: without one the others remain, so the single gains do
    not add up to the total loss.
    """
    gains = sorted((milled.get("gain_db_without") or {}).items(), key=lambda row: -row[1])
    if not gains or gains[0][1] < _WORTH_DB:
        return []
    gain_db, (cause, remedy) = gains[0][1], CAUSES[gains[0][0]]
    lost_db = (milled.get("psnr_db_designed") or milled["psnr_db"]) - milled["psnr_db"]
    if lost_db <= 0 or gain_db >= _MOST_OF_IT * lost_db:
        return [
            Phrase(
                "Most of the loss comes from {cause} ({gain_db:.1f} dB would be gained without them): {remedy}.",
                cause=cause,
                gain_db=gain_db,
                remedy=remedy,
            )
        ]
    others = Phrase("the other marks")
    for name, _ in gains[1:2]:
        others = Phrase("the other marks, {cause} first,", cause=CAUSES[name][0])
    return [
        Phrase(
            "Of the {lost_db:.1f} dB that milling costs, the largest part comes from {cause} ({remedy}); without "
            "them alone only {gain_db:.1f} dB would come back, because {others} hide as much.",
            lost_db=lost_db,
            cause=cause,
            remedy=remedy,
            gain_db=gain_db,
            others=others,
        )
    ]


def explain_flaws(finished: Mapping[str, Any]) -> Iterator[Phrase]:
    """Yield the flaws of the block that cost much after a finish, which removes the marks of milling; from report
    `as_finished`.
    """
    for name, gain_db in (finished.get("gain_db_without") or {}).items():
        if gain_db >= _WORTH_DB:
            cause, remedy = CAUSES[name]
            yield Phrase("{gain_db:.1f} dB are lost by {cause}: {remedy}.", gain_db=gain_db, cause=cause, remedy=remedy)


def detail_lost(milled: Mapping[str, Any], *, planned: bool = False) -> Phrase | None:
    """Return a warning if the milled surface blurs by more than a pixel and the picture has detail that fine.

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


def _describe_expectation(milled: Mapping[str, Any], *, finished: bool) -> Phrase:
    designed_db, milled_db = milled.get("psnr_db_designed"), milled["psnr_db"]
    given = milled.get("against_original") or milled  # a person compares with the given picture
    told = Phrase(
        "As the block comes from the machine ({psnr_db:.1f} dB): {seen}.",
        psnr_db=given["psnr_db"],
        seen=likeness_in_words(given.get("seen_db")),
    )
    if designed_db is None:
        return told
    if designed_db < milled_db:
        return Phrase(
            "{told} Do not polish it: the lens is made for these marks, and shows {psnr_db:.1f} dB without them.",
            told=told,
            psnr_db=designed_db,
        )
    if not finished:
        return told
    return Phrase(
        "{told} Polished until no groove is left ({psnr_db:.1f} dB): {seen}.",
        told=told,
        psnr_db=designed_db,
        seen=likeness_in_words(milled.get("seen_db_designed")),
    )


def _blur(milled: Mapping[str, Any]) -> Phrase:
    return Phrase(
        "For experts: its slopes are off by {slope_um:.1f} µm per mm ({slope_mrad:.1f} mrad) rms, which blurs the "
        "picture by {x_px:.1f} pixels in X and {y_px:.1f} in Y (rms; with steps of {step_um} µm and height errors of "
        "{noise_um} µm).",
        slope_um=milled["slope_rms_mrad"],
        slope_mrad=milled["slope_rms_mrad"],
        x_px=milled["blur_x_px"],
        y_px=milled["blur_y_px"],
        step_um=number(1000 * milled["step_mm"], 2),
        noise_um=number(1000 * milled["z_noise_mm"], 2),
    )
