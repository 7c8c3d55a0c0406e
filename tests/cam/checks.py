"""The mill that programs of the tests are checked for, and the check of one pass as the service makes it."""

from __future__ import annotations

from cam.checking.check import PassCheck, check_program
from cam.duration import Kinematics
from cam.passes import PassSpec, Stock
from cam.posts.dialects import GRBL
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from tests.cam.programs import generate_program

MILL = Kinematics(
    max_rate_mm_per_min=(5000, 5000, 3000),
    acceleration_mm_per_s2=(500, 500, 300),
    junction_deviation_mm=0.01,
    planner_blocks=16,
    lines_per_s=400,
)


def checked(lens: Heightfield, spec: PassSpec, stock: Stock, top: StockGrid) -> PassCheck:
    """The pass as written for GRBL, checked on the stock that is given."""
    return check_program(
        generate_program(lens, spec, stock, stock_top=top, post=GRBL),
        heightfield=lens,
        spec=spec,
        stock=stock,
        stock_top=top,
        kinematics=MILL,
        safe_z_mm=5.0,
    )
