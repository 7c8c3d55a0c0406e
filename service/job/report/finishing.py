"""The setup sheet's part on finishing by hand, made from report.json alone: the work, its tolerance, and the witness
marks: where they are, how to look at them, and when each disappears.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from phrases.phrase import Phrase, join
from service.job.files import table
from service.job.report.milled import explain_flaws
from service.wording import duration, likeness_in_words, number

_WORTH_DB = 0.3
_SENTENCES = ("needs", "steps", "donts")
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


def make_finishing_card(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return title, rows (what, figure), warnings, and the sentences on the process and on the rims; None if a job has
    no finish.

    report : of it the parts `finishing` (what to do), `as_finished` and `as_milled` (the results),
             `finish_tolerance`, `witness`, `rim_room`
    """
    work = table(report.get("finishing"))
    if not work:
        return None
    return {
        "title": str(work.get("title") or work.get("process") or Phrase("by hand")),
        "tolerance": list(list_finish_tolerance(report)),
        "rims": [advice] if (advice := table(report.get("rim_room")).get("advice")) else [],
        "witness": _describe_witness(report),
        "rows": [*_work_rows(work), *_check_rows(report), *_light_rows(report)],
        "warnings": list(_warnings(report, work)),
        **{key: [str(sentence) for sentence in work.get(key) or ()] for key in _SENTENCES},
        **{key: str(work.get(key) or "") for key in ("when_to_stop", "law")},
    }


def _work_rows(work: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    if work.get("minutes") is not None:
        yield Phrase("Time, the whole lens"), duration(60 * work["minutes"])
    if depth_um := work.get("depth_um"):
        yield Phrase("Comes off") if depth_um > 0 else Phrase("Is added"), f"{number(abs(depth_um), 1)} µm"
    if work.get("removal"):
        yield Phrase("What comes off"), str(work["removal"])
    levelled_mm, kept_mm, pad_mm = (work.get(key) for key in ("levelled_mm", "kept_mm", "pad_mm"))
    if levelled_mm and kept_mm:
        kept: str = _mm(kept_mm)
        if pad_mm is not None and pad_mm < kept_mm:
            kept = Phrase("{pad_mm} mm, the size of the tool that follows them", pad_mm=number(pad_mm, 1))
        levels = Phrase(
            "waves under {levelled} to a tenth of their height; leaves those over {kept}",
            levelled=_mm(levelled_mm),
            kept=kept,
        )
        yield Phrase("Levels"), levels
    if work.get("run_out_mm"):
        mask = Phrase(
            "mask them, or finish {run_out} beyond the lens: edges are rounded that far in",
            run_out=_mm(work["run_out_mm"]),
        )
        yield Phrase("Rims"), mask


def _check_rows(report: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    if removed_g := table(report.get("rim_room")).get("removed_g"):
        words = Phrase(
            "weigh the block, washed and dry, before and after: {removed_g} g come off, on a scale that shows a tenth "
            "of that. A dial gauge cannot show it, because no flat beside the lens is finished as well.",
            removed_g=f"{removed_g:.2g}",
        )
        yield Phrase("To check it"), words


def _light_rows(report: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    rows = {"as_milled": Phrase("The wall as milled"), "as_finished": Phrase("The wall as finished")}
    for key, what in rows.items():
        seen = table(report.get(key))
        if (against := seen.get("against_original") or seen).get("psnr_db") is not None:
            words = likeness_in_words(against.get("seen_db"))
            parts = [Phrase("{psnr_db:.1f} dB: {seen}", psnr_db=against["psnr_db"], seen=words)]
            if (detail_mm := seen.get("smallest_detail_mm")) is not None:
                parts.append(Phrase("details from {detail} show", detail=_mm(detail_mm)))
            yield what, join("; ", parts)
        if (share := seen.get("contact_share")) is not None:
            yield Phrase("The tool touches"), Phrase("{percent:.0f} % of the lens", percent=100 * share)


def _warnings(report: Mapping[str, Any], work: Mapping[str, Any]) -> Iterator[Phrase]:
    milled_db, finished_db = (table(report.get(key)).get("psnr_db") for key in ("as_milled", "as_finished"))
    if milled_db is not None and finished_db is not None and finished_db < milled_db - _WORTH_DB:
        yield Phrase(
            "This finish makes the picture worse, {finished_db:.1f} dB instead of {milled_db:.1f} dB as milled: leave "
            "it out, or finish for longer. Half-levelled rows merge into waves that bend the light further.",
            finished_db=finished_db,
            milled_db=milled_db,
        )
    yield from explain_flaws(table(report.get("as_finished")))
    minutes, least, most = (work.get(key) for key in ("minutes", "least_minutes", "most_minutes"))
    if minutes is not None and least is not None and most is not None and not least <= minutes <= most:
        yield Phrase(
            "{duration} is outside the known range of this process, {least} to {most} on a lens of this size: the "
            "prediction may be wrong. Try it on a test piece.",
            duration=duration(60 * minutes),
            least=duration(60 * least),
            most=duration(60 * most),
        )
    if not work.get("steps"):
        yield Phrase("This process is in no library: there are no instructions for it, its figures are your own.")


def _mm(length_mm: float) -> str:
    return f"{length_mm:.2g} mm" if length_mm < 10 else f"{length_mm:.0f} mm"


def list_finish_tolerance(report: Mapping[str, Any]) -> Iterator[Phrase]:
    """Yield the minutes first, then the result of too little and too much work, then the tool; nothing if the tolerance
    is not known.

    report : of it the parts `finish_tolerance` and `finishing`
    """
    found, work = table(report.get("finish_tolerance")), table(report.get("finishing"))
    minutes = work.get("minutes")
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
    if (pad_mm := work.get("pad_mm")) is not None:
        yield Phrase(
            "All this assumes a pad of {pad_mm} mm, as soft as the list says, pressed as the steps say and evenly: "
            "with less pressure the hollows stay rough, and a harder pad levels only the ridges.",
            pad_mm=number(pad_mm, 1),
        )


def _describe_witness(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return rows (when, what can be seen) and sentences; None for a job that has neither marks nor a reason for their
    absence.

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
