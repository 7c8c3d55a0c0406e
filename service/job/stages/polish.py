"""The stage that polishes on the mill: plans a bob's dwell, writes its program, reads it back, and computes from its
moves what comes off; report `polish`, and the unevenness for the light as finished.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cam.passes import Stock
from cam.polish.check import PolishCheck, check_polish
from cam.polish.cut import PolishCut
from cam.polish.path import Lattice, count_rounds, cover, lay_lattice, polish_paths
from cam.surface.stock_grid import StockGrid
from optics.bob import Bob
from optics.bob_wear import Contacts, Ground
from optics.finish import Finish
from optics.heightfield import Array, Heightfield
from phrases.phrase import Phrase
from service.errors import FailedError
from service.job import arrays
from service.job.files import HEIGHTFIELD, LAST_STOCK, POLISH, UNEVENNESS, read_chunks
from service.job.spec.bob import build_bob
from service.job.spec.lens_task import finish_of
from service.job.spec.resolve import cam_stock_of, polish_cut_of
from service.job.stages.around import checked_mill_of, row_of, write_around
from service.job.stages.context import StageContext
from service.job.stages.programs import require_passed

_GROUND_MM = 2.5  # contact radii of ground around the lens
_MEAN_ALLOWED, _UNEVEN_ALLOWED = 0.05, 0.15  # of the planned depth: of its mean; rms


def run_polish(context: StageContext) -> None:
    """Write the polishing program; its row of report `around`, and report `polish`.

    FailedError: it would press or rub too much, meet the wall beside the lens, or take off another depth than planned.
    """
    task, finish, given = polish_cut_of(context.job), finish_of(context.spec), context.spec.finish.bob
    assert task is not None and finish is not None and finish.depth_mm is not None and given is not None
    lens = context.receive(HEIGHTFIELD, arrays.load_heightfield)
    top = context.receive(LAST_STOCK, arrays.load_stock)
    stock, bob = cam_stock_of(context.spec), build_bob(given)
    with context.watch.stage("plan polish"):
        ground = Ground.under(bob, lens, beyond_mm=_GROUND_MM * bob.contact_mm)
        surface = cover(task, lens)
        lattice, dwell_s, rounds = plan_polish(ground, task, bob, lens, stock, finish)
    number = len(context.spec.passes) + context.spec.finish.witnessed + 1
    paths = polish_paths(
        *(surface, lattice, dwell_s, task),
        rounds=rounds,
        top_mm=float(top.top_mm.max()),
        safe_z_mm=context.machine.safe_z_mm,
    )
    written = write_around(context, number, POLISH, paths, task)
    called = written[0].file
    with context.watch.stage(f"check {called}"):
        found = require_passed(
            called,
            lambda: check_polish(
                (read_chunks(context.folder / part.file) for part in written),
                task,
                lens=lens,
                stock=stock,
                stock_top=top,
                mill=checked_mill_of(context.machine),
            ),
        )
        off_mm = wear_of(ground, bob, found)
    figures = _judge_removal(called, off_mm[ground.inside], finish.depth_mm)
    settings = {"name": POLISH, "tool": "bob", **given.model_dump(exclude_none=True)}
    context.report["around"] = {POLISH: row_of(written, found.verdict, settings)}
    planned_s = float(dwell_s.sum())
    context.report["polish"] = {
        **figures,
        "rounds": rounds,
        "planned_s": planned_s,
        "force_n": bob.force_n,
        "pressure_mpa": bob.mean_pressure_mpa,
        "contact_mm": bob.contact_mm,
        "compression_mm": list(found.compression_mm),
        "fastest_mm_per_s": found.fastest_mm_per_s,
    }
    _hand_over(context, ground, ground.unevenness_mm(off_mm, finish))


def plan_polish(
    ground: Ground, task: PolishCut, bob: Bob, lens: Heightfield, stock: Stock, finish: Finish
) -> tuple[Lattice, Array, int]:
    """Return the lattice of the path, dwell (ny, nx) at its nodes over all rounds [s], and the number of rounds."""
    assert finish.depth_mm is not None
    lattice = lay_lattice(cover(task, lens), stock, task)
    near = lattice.near
    away = (task.radius_mm - task.compression_mm) * 0.999
    sine = np.minimum(np.hypot(*np.moveaxis(lattice.at_mm - lattice.tip_mm[:, :, :2], 2, 0)) / away, 0.999)
    slope = (sine / np.sqrt(1.0 - sine**2))[near]
    guess = finish.depth_mm * task.node_mm**2 / np.array([bob.rate_mm3_per_s(float(one)) for one in slope])
    contacts = Contacts(at_mm=lattice.at_mm[near], tip_mm=lattice.tip_mm[near], dwell_s=guess)
    free = ground.plan_dwell(bob, contacts, finish.depth_mm)
    rounds = count_rounds(free, task)
    dwell = ground.plan_dwell(bob, contacts, finish.depth_mm, least_s=rounds * task.least_dwell_s)
    return lattice, lattice.spread(dwell), rounds


def wear_of(ground: Ground, bob: Bob, found: PolishCheck) -> Array:
    """Return (ny, nx) what a program takes off, as its moves say."""
    return ground.wear(bob, Contacts(at_mm=found.at_mm, tip_mm=found.tip_mm, dwell_s=found.dwell_s))


def _judge_removal(called: str, off_mm: Array, depth_mm: float) -> dict[str, Any]:
    """Return the figures of what comes off the lens; FailedError if that is not what was planned."""
    mean, rms = float(off_mm.mean()), float(off_mm.std())
    if abs(mean - depth_mm) > _MEAN_ALLOWED * depth_mm or rms > _UNEVEN_ALLOWED * depth_mm:
        words = Phrase(
            "{name}: takes off {mean_um:.1f} µm and varies by {rms_um:.1f} µm rms (planned: {depth_um:.1f} µm, allowed "
            "{off_um:.1f} off and {uneven_um:.1f} rms): a smaller bob follows narrow valleys; a slower spindle allows "
            "the feed that it needs",
            name=called,
            mean_um=1000 * mean,
            rms_um=1000 * rms,
            depth_um=1000 * depth_mm,
            off_um=1000 * _MEAN_ALLOWED * depth_mm,
            uneven_um=1000 * _UNEVEN_ALLOWED * depth_mm,
        )
        raise FailedError(words)
    return {"depth_um": 1000 * depth_mm, "mean_um": 1000 * mean, "rms_um": 1000 * rms}


def _hand_over(context: StageContext, ground: Ground, uneven_mm: Array) -> None:
    grid = StockGrid(
        x0_mm=ground.x0_mm - ground.cell_mm / 2,
        y0_mm=ground.y0_mm - ground.cell_mm / 2,
        cell_mm=ground.cell_mm,
        top_mm=uneven_mm,
    )
    context.hand_over(UNEVENNESS, grid, arrays.stock_bytes)
