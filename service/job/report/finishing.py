"""What the setup sheet says of finishing by hand, made from report.json alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from phrases.phrase import Phrase, join
from service.job.finite_json import table
from service.job.report.finish_tolerance import tolerance_sentences
from service.job.report.witness import describe_witness
from service.wording import duration, number, psnr_in_words

_WORTH_DB = 0.3
_SENTENCES = ("needs", "steps", "donts")


def make_finishing_card(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return title, rows (what, figure), warnings and the sentences of the process and on the rims; None where a job
    has no finish.

    report : of it the parts `finishing` (what to do), `as_finished` and `as_milled` (what comes of it),
             `finish_tolerance`, `witness`, `rim_room`
    """
    told = table(report.get("finishing"))
    if not told:
        return None
    return {
        "title": str(told.get("title") or told.get("process") or Phrase("by hand")),
        "tolerance": list(tolerance_sentences(report)),
        "rims": [advice] if (advice := table(report.get("rim_room")).get("advice")) else [],
        "witness": describe_witness(report),
        "rows": [*_work_rows(told), *_check_rows(report), *_light_rows(report)],
        "warnings": list(_warnings(report, told)),
        **{key: [str(sentence) for sentence in told.get(key) or ()] for key in _SENTENCES},
        **{key: str(told.get(key) or "") for key in ("when_to_stop", "law")},
    }


def _work_rows(told: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    if told.get("minutes") is not None:
        yield Phrase("Time, the whole lens"), duration(60 * told["minutes"])
    if depth_um := told.get("depth_um"):
        yield Phrase("Comes off") if depth_um > 0 else Phrase("Is added"), f"{number(abs(depth_um), 1)} µm"
    if told.get("removal"):
        yield Phrase("What comes off"), str(told["removal"])
    levelled_mm, kept_mm, pad_mm = (told.get(key) for key in ("levelled_mm", "kept_mm", "pad_mm"))
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
    if told.get("run_out_mm"):
        mask = Phrase(
            "mask them, or finish {run_out} beyond the lens: edges are rounded that far in",
            run_out=_mm(told["run_out_mm"]),
        )
        yield Phrase("Rims"), mask


def _check_rows(report: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    if removed_g := table(report.get("rim_room")).get("removed_g"):
        words = Phrase(
            "weigh the block, washed and dry, before and after: {removed_g} g come off, on a scale that shows a tenth "
            "of that. No flat beside the lens is worked with it, on which a dial gauge could tell.",
            removed_g=f"{removed_g:.2g}",
        )
        yield Phrase("To check it"), words


def _light_rows(report: Mapping[str, Any]) -> Iterator[tuple[Phrase, str]]:
    rows = {"as_milled": Phrase("The wall as milled"), "as_finished": Phrase("The wall as finished")}
    for key, what in rows.items():
        seen = table(report.get(key))
        likeness_db = table(seen.get("against_original")).get("psnr_db", seen.get("psnr_db"))
        if likeness_db is not None:
            parts = [Phrase("{psnr_db:.1f} dB: {seen}", psnr_db=likeness_db, seen=psnr_in_words(likeness_db))]
            if (detail_mm := seen.get("smallest_detail_mm")) is not None:
                parts.append(Phrase("details from {detail} show", detail=_mm(detail_mm)))
            yield what, join("; ", parts)
        if (share := seen.get("contact_share")) is not None:
            yield Phrase("The tool touches"), Phrase("{percent:.0f} % of the lens", percent=100 * share)


def _warnings(report: Mapping[str, Any], told: Mapping[str, Any]) -> Iterator[Phrase]:
    milled_db, finished_db = (table(report.get(key)).get("psnr_db") for key in ("as_milled", "as_finished"))
    if milled_db is not None and finished_db is not None and finished_db < milled_db - _WORTH_DB:
        yield Phrase(
            "This finish makes the picture worse, {finished_db:.1f} dB instead of {milled_db:.1f} dB as milled: leave "
            "it out, or finish for longer. Half-levelled rows merge into waves that bend the light further.",
            finished_db=finished_db,
            milled_db=milled_db,
        )
    minutes, least, most = (told.get(key) for key in ("minutes", "least_minutes", "most_minutes"))
    if minutes is not None and least is not None and most is not None and not least <= minutes <= most:
        yield Phrase(
            "{duration} is outside the known range of this process, {least} to {most} on a lens of this size: the "
            "prediction may be wrong. Try it on a test piece.",
            duration=duration(60 * minutes),
            least=duration(60 * least),
            most=duration(60 * most),
        )
    if not told.get("steps"):
        yield Phrase("This process is in no library: there are no instructions for it, its figures are your own.")


def _mm(length_mm: float) -> str:
    return f"{length_mm:.2g} mm" if length_mm < 10 else f"{length_mm:.0f} mm"
