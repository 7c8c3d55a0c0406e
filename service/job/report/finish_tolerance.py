"""How exactly a finish has to be hit, in sentences for the setup sheet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from phrases.phrase import Phrase
from service.job.finite_json import table
from service.wording import duration, number


def tolerance_sentences(report: Mapping[str, Any]) -> Iterator[Phrase]:
    """Yield the minutes first, then what too little and too much show, then the tool; nothing where it is not known.

    report : of it the parts `finish_tolerance` and `finishing`
    """
    found, told = table(report.get("finish_tolerance")), table(report.get("finishing"))
    minutes = told.get("minutes")
    if not found:
        return
    (low, high), (little, planned, much) = found["within_ratio"], found["psnr_db"]
    values = {"loss_db": found["loss_db"], "planned_db": planned, "little_db": little, "much_db": much}
    if minutes is None:
        less, more = (abs(100 * (ratio - 1)) for ratio in (low, high))
        yield Phrase(
            "Do the planned work; up to {less:.0f} % less or {more:.0f} % more keep the picture within about "
            "{loss_db:g} dB of the predicted {planned_db:.1f} dB.",
            less=less,
            more=more,
            **values,
        )
        parts = [str(Phrase("{percent:.0f} % of the work", percent=100 * one)) for one in found["minutes_ratio"]]
    else:
        yield Phrase(
            "Finish for {minutes}; up to {less} less or {more} more keep the picture within about {loss_db:g} dB "
            "of the predicted {planned_db:.1f} dB.",
            minutes=duration(60 * minutes),
            less=duration(60 * minutes * (1 - low)),
            more=duration(60 * minutes * (high - 1)),
            **values,
        )
        parts = [duration(60 * minutes * one) for one in found["minutes_ratio"]]
    yield Phrase(
        "The pictures show, from left to right, too little ({before}: {little_db:.1f} dB), the plan, and too much "
        "({after}: {much_db:.1f} dB).",
        before=parts[0],
        after=parts[1],
        **values,
    )
    if little >= much:
        yield Phrase("Too little is safer: you can add work, but not take it back.")
    if (pad_mm := told.get("pad_mm")) is not None:
        yield Phrase(
            "All this assumes a pad of {pad_mm} mm, as soft as the list says, pressed as the steps say and evenly: "
            "with less pressure the hollows stay rough, and a harder pad levels only the ridges.",
            pad_mm=number(pad_mm, 1),
        )
