"""What the setup sheet says of the witness marks: where they are, how they are looked at, which is gone when."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from phrases.phrase import Phrase
from service.job.finite_json import table
from service.wording import duration

_SIDES = {
    "front": Phrase("in front of the lens, mark 1 at its left end"),
    "back": Phrase("behind the lens, mark 1 at its left end"),
    "left": Phrase("left of the lens, mark 1 at its front end"),
    "right": Phrase("right of the lens, mark 1 at its front end"),
}
_OBSTACLES = {
    "room": Phrase(
        "There are no witness marks beside this lens: its margin has no free strip that both a pad and the mill "
        "can reach. A wider stock.margin_mm, or clamps elsewhere, make room."
    ),
    "steps": Phrase(
        "There are no witness marks beside this lens: the mill's steps in height are higher than the ripples that "
        "this pad can follow."
    ),
    "noise": Phrase(
        "There are no witness marks beside this lens: the mill's errors from row to row are as high as the ripples "
        "that this pad can follow."
    ),
    "slope": Phrase(
        "There are no witness marks beside this lens: a lamp shows too little of the ripples that this pad can follow."
    ),
}
_STOP = 1.0


def describe_witness(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return rows (when, what is to be seen) and sentences; None for a job without marks and without a reason.

    report : of it the parts `witness` and `finishing`
    """
    made, minutes = table(report.get("witness")), table(report.get("finishing")).get("minutes")
    if obstacle := made.get("obstacle"):
        return {"rows": [], "sentences": [_OBSTACLES[obstacle]]}
    marks = made.get("marks") or []
    if not marks or minutes is None:
        return None
    return {"rows": list(_rows(marks, minutes)), "sentences": list(_sentences(made, marks, minutes))}


def _rows(marks: list[Mapping[str, Any]], minutes: float) -> Iterator[tuple[str, Phrase]]:
    for number_, mark in enumerate(marks, 1):
        gone = Phrase(
            "mark {number}, ripples {period_mm:.2g} mm apart, has just disappeared",
            number=number_,
            period_mm=mark["period_mm"],
        )
        if mark["share"] == _STOP:
            gone = Phrase("{gone}: stop now", gone=gone)
        elif mark["share"] > _STOP:
            gone = Phrase("{gone}: too far", gone=gone)
        yield duration(60 * minutes * mark["share"]), gone


def _sentences(made: Mapping[str, Any], marks: list[Mapping[str, Any]], minutes: float) -> Iterator[Phrase]:
    stop = 1 + next(k for k, mark in enumerate(marks) if mark["share"] == _STOP)
    yield Phrase(
        "A strip of {count} witness marks lies {side}. Finish the strip exactly as the lens, from the first minute on: "
        "the same pad, pressure, rounds and pace.",
        count=len(marks),
        side=_SIDES[str(made["side"])],
    )
    yield Phrase(
        "Look for the first time after {first}, then every {every}: wash and dry the strip, hold a lamp almost "
        "flat along it, so that the light crosses the ripples, and look at the middle of each mark, not at the "
        "ends of its ripples. A ripple shows while its slope is over about {slope_um_per_mm:g} µm per mm "
        "({slope_um_per_mm:g} mrad).",
        first=duration(60 * minutes * marks[0]["share"]),
        every=duration(60 * minutes * 0.1),
        slope_um_per_mm=1000 * made["visible_slope_rad"],
    )
    if made["wall_mm"] is not None:
        yield Phrase(
            "A photograph measures it to a few percent: cover all but the strip with tape, put one small bright "
            "LED 2 m or more behind the flat back and tracing paper {wall_mm:g} mm before the strip, photograph "
            "the paper from its other side in a dark room, and run causticmill look PHOTO --job FOLDER --marks.",
            wall_mm=made["wall_mm"],
        )
    yield Phrase(
        "Go by the marks, not by the clock: stop as soon as mark {stop} can no longer be seen. If mark 1 "
        "disappears earlier or later than the table says, all others do so in the same ratio. Mark {after} must "
        "still be plainly visible: you can add work, but not take it back.",
        stop=stop,
        after=stop + 1,
    )
