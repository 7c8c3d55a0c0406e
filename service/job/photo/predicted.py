"""What a job predicts of the light on its wall: the lens, its set-up, and the best picture there is in its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.heightfield import Heightfield
from optics.irradiance import ViewedFrom, flip_between_picture_and_work_frame
from optics.spline import Array
from phrases.phrase import Phrase
from service.errors import InputError
from service.job import arrays
from service.job.files import HEIGHTFIELD, MAP
from service.job.picture.linear_light import srgb_to_linear
from service.job.report.pictures import PREDICTED, PredictedKind
from service.job.spec.lens_task import bench_of
from service.job.spec.loading import load_stored_spec


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PredictedLight:
    """irradiance (ny, nx): work frame, mean about 1; NaN where its file holds no more than "white or brighter"."""

    kind: PredictedKind
    lens: Heightfield
    bench: Bench
    irradiance: Array
    viewed_from: ViewedFrom

    @property
    def bounded(self) -> Array:
        """The irradiance with the brightest known one in place of what is brighter."""
        return np.nan_to_num(self.irradiance, nan=float(np.nanmax(self.irradiance)))


def load_predicted_light(folder: Path) -> PredictedLight:
    """Load the predicted light of a job that has a lens; InputError where it has none, or another program's files."""
    if not folder.is_dir():
        raise InputError(f"--job: {folder} is no folder; allowed: the folder of an earlier design or make")
    spec = load_stored_spec(folder)
    lens = arrays.load_heightfield(folder / HEIGHTFIELD)
    target = arrays.load_target(folder / MAP)
    bench, viewed_from = bench_of(spec), spec.optics.viewed_from
    for kind, name in PREDICTED.items():
        seen = _picture(folder / name, target)
        if seen is not None:
            irradiance = flip_between_picture_and_work_frame(seen, viewed_from)
            return PredictedLight(kind=kind, lens=lens, bench=bench, irradiance=irradiance, viewed_from=viewed_from)
    light = simulate_caustic(lens, bench, pixels=(target.shape[0], target.shape[1])).irradiance
    return PredictedLight(kind="designed", lens=lens, bench=bench, irradiance=light, viewed_from=viewed_from)


def _picture(path: Path, target: Array) -> Array | None:
    """Return the irradiance of a picture of ours, whose white is the target's brightest pixel; None where there is
    none.
    """
    try:
        with Image.open(path, formats=("PNG",)) as image:
            levels = np.asarray(image.convert("L"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, SyntaxError):
        words = Phrase("{path}: not a picture of this program; `causticmill make` writes a new one", path=path)
        raise InputError(words) from None
    if levels.shape != target.shape:
        return None
    linear = srgb_to_linear(levels / 255.0) * float(target.max())
    return np.where(levels == 255, np.nan, linear)
