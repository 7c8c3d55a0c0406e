"""How much of the picture one will recognise, foretold for an estimate with the planner's eyes."""

from __future__ import annotations

from cam.pass_time import LensForm
from cam.passes import PassSpec
from cam.planner import Marks
from cam.row_slopes import RowSlopes
from optics.bench import Bench
from optics.finish import Finish
from optics.heightfield import Array
from service.job.planning.finished_light import FinishedLight
from service.plan_light import PictureLight

MOST_PIXELS = 512
"""Along the longer side of the picture that is compared: finer detail changes what one recognises little."""


def foretold_db(
    target: Array,
    bench: Bench,
    form: LensForm,
    missed: Array,
    finish: PassSpec,
    slopes: RowSlopes,
    *,
    aims: bool,
    by_hand: Finish | None = None,
) -> float:
    """PSNR of the milled lens against a target (ny, nx), mean 1.

    missed : light of the lens, at any size, less what it aims at. aims : the lens is made sharper for those rows
    by_hand : what is done after milling
    """
    light, marks = PictureLight(target, bench, aims=aims), Marks(spec=finish, slopes=slopes)
    light.add(finish.radius_mm, form, missed)
    return light.aimed_db(marks) if by_hand is None else FinishedLight(light, by_hand).psnr_db(marks)
