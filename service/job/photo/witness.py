"""Evaluates a photograph of the witness marks' light: how far the finish has come, and how much work is left."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optics.witness_light import DoseReading, Refusal, StripNotFoundError, fit_dose, read_strip
from phrases.phrase import Phrase
from service.errors import InputError, PictureError
from service.job.coupon.photograph import read_photo
from service.job.files import read_report, table
from service.job.planning.witness import plan_witness
from service.job.spec.lens_task import finish_of
from service.job.spec.loading import load_stored_job
from service.wording import duration

_DONE = 0.06  # of the dose: closer to the plan than this no difference is visible
_REFUSALS: dict[Refusal, Phrase] = {
    "no_light": Phrase(
        "the photograph shows no lit strip; allowed: the light of the witness marks alone, everything else "
        "covered, in a dark room"
    ),
    "too_dark": Phrase("the strip's light is hardly above the dark around it; expose longer"),
    "too_bright": Phrase("the strip's light is white and shows no fringes; expose one or two stops less"),
    "too_small": Phrase(
        "the strip is too small in the photograph; allowed: at least 300 pixels along it, all of it seen"
    ),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class WitnessFinding:
    """reading: share of the planned dose; minutes: of the plan, None if it has none; worked: minutes so far, if the
    person gave them; psnr_db: of the wall by now, if the report has the data for it.
    """

    reading: DoseReading
    minutes: float | None
    worked: float | None
    psnr_db: float | None

    def sentences(self) -> Iterator[Phrase]:
        """Yield the state of the finish, then the next step."""
        dose = self.reading.dose
        yield Phrase(
            "the finish has reached {percent:.0f} % of the plan (+-{error:.0f})",
            percent=100 * dose,
            error=100 * self.reading.error,
        )
        if dose < 1.0 - _DONE:
            yield from self._describe_rest(dose)
        elif dose <= 1.0 + _DONE:
            yield Phrase("stop: it is done")
        elif self.psnr_db is None:
            yield Phrase("too far: stop")
        else:
            yield Phrase("too far: stop; the wall shows about {psnr_db:.1f} dB now", psnr_db=self.psnr_db)

    def _describe_rest(self, dose: float) -> Iterator[Phrase]:
        if self.worked is not None:
            left = self.worked * (1.0 / dose - 1.0)
        elif self.minutes is not None:
            left = self.minutes * (1.0 - dose)
        else:
            yield Phrase("go on: {percent:.0f} % of the work is left", percent=100 * (1.0 - dose))
            return
        yield Phrase("another {minutes}, at the same pace", minutes=duration(60 * left))


def read_witness_photo(photo: Path, job: Path, *, worked_minutes: float | None = None) -> WitnessFinding:
    """Evaluate a photograph of the marks of the job in a folder. InputError if the job has none, PictureError if the
    photograph shows none.
    """
    report, resolved = read_report(job), load_stored_job(job)
    finish = finish_of(resolved.spec)
    if finish is None or not table(report.get("witness")).get("marks"):
        raise InputError(f"--job: {job} has no witness marks; allowed: the folder of a job whose sheet tells of them")
    strip = plan_witness(resolved).strip
    try:
        seen = read_strip(read_photo(photo).light, strip)
    except StripNotFoundError as error:
        raise PictureError(Phrase("{name}: {sentence}", name=str(photo), sentence=_REFUSALS[error.code])) from None
    reading = fit_dose(seen, strip, finish, refractive_index=resolved.spec.optics.refractive_index)
    return WitnessFinding(
        reading=reading,
        minutes=table(report.get("finishing")).get("minutes"),
        worked=worked_minutes,
        psnr_db=_wall_at(reading.dose, table(report.get("finish_tolerance"))),
    )


def _wall_at(dose: float, tolerance: Mapping[str, Any]) -> float | None:
    """Return the likeness of the wall after more work than planned: the loss grows with the square of the dose's
    logarithm and passes through the simulated value; None beyond that.
    """
    if not tolerance:
        return None
    (_, planned, much), (_, most) = tolerance["psnr_db"], tolerance["minutes_ratio"]
    share = math.log(max(dose, 1.0)) / math.log(most)
    return None if share > 1.1 else float(planned + (much - planned) * share**2)
