"""What the setup sheet says of finishing by hand, made from report.json alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from service.job.finite_json import table
from service.wording import duration, number, psnr_in_words

_WORTH_DB = 0.3
_SENTENCES = ("needs", "steps", "donts")


def make_finishing_card(report: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return title, rows (what, figure), warnings and the sentences of the process; None where a job has no finish.

    report : of it the parts `finishing` (what to do), `as_finished` and `as_milled` (what comes of it)
    """
    told = table(report.get("finishing"))
    if not told:
        return None
    return {
        "title": str(told.get("title") or told.get("process") or "by hand"),
        "rows": [*_work_rows(told), *_light_rows(report)],
        "warnings": list(_warnings(report, told)),
        **{key: [str(sentence) for sentence in told.get(key) or ()] for key in _SENTENCES},
        **{key: str(told.get(key) or "") for key in ("when_to_stop", "law")},
    }


def _work_rows(told: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    if told.get("minutes") is not None:
        yield "Time, the whole lens", duration(60 * told["minutes"])
    depth_um = told.get("depth_um")
    if depth_um:
        yield ("Comes off", f"{number(depth_um, 1)} µm") if depth_um > 0 else ("Is added", f"{number(-depth_um, 1)} µm")
    if told.get("removal"):
        yield "What comes off", str(told["removal"])
    levelled_mm, kept_mm, pad_mm = (told.get(key) for key in ("levelled_mm", "kept_mm", "pad_mm"))
    if levelled_mm and kept_mm:
        follows = pad_mm is not None and pad_mm < kept_mm
        kept = f"{number(pad_mm, 1)} mm, the size of the tool that follows them" if follows else f"{_mm(kept_mm)}"
        yield "Levels", f"waves under {_mm(levelled_mm)} to a tenth of their height; leaves those over {kept}"
    if told.get("run_out_mm"):
        yield (
            "Rims",
            f"mask them, or finish {_mm(told['run_out_mm'])} beyond the lens: edges are rounded as far as that",
        )


def _light_rows(report: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for key, words in (("as_milled", "The wall as milled"), ("as_finished", "The wall as finished")):
        seen = table(report.get(key))
        likeness_db = table(seen.get("against_original")).get("psnr_db", seen.get("psnr_db"))
        if likeness_db is not None:
            detail_mm = seen.get("smallest_detail_mm")
            detail = f"; details from {_mm(detail_mm)} show" if detail_mm is not None else ""
            yield words, f"{likeness_db:.1f} dB: {psnr_in_words(likeness_db)}{detail}"


def _warnings(report: Mapping[str, Any], told: Mapping[str, Any]) -> Iterator[str]:
    milled, finished = (table(report.get(key)).get("psnr_db") for key in ("as_milled", "as_finished"))
    if milled is not None and finished is not None and finished < milled - _WORTH_DB:
        yield (
            f"This finish makes the picture worse, {finished:.1f} dB instead of {milled:.1f} dB as milled: leave it "
            "out, or finish for longer. Half-levelled rows merge into waves that bend the light further."
        )
    minutes, least, most = (told.get(key) for key in ("minutes", "least_minutes", "most_minutes"))
    if minutes is not None and least is not None and most is not None and not least <= minutes <= most:
        yield (
            f"{duration(60 * minutes)} lies outside what this process is known for, {duration(60 * least)} to "
            f"{duration(60 * most)} on a lens of this size: what is foretold may be wrong. A test piece tells."
        )
    if not told.get("steps"):
        yield "This process is in no library: there are no instructions for it, its figures are your own."


def _mm(length_mm: float) -> str:
    return f"{length_mm:.2g} mm" if length_mm < 10 else f"{length_mm:.0f} mm"
