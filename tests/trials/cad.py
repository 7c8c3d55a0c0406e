"""lens.step read by OpenCascade, the kernel of FreeCAD and others (extra `soak`: cadquery-ocp-novtk).

A lens of a photograph at full size, 1025 x 1025 points: square, round, and as a mirror. Each must be one closed valid
solid of the right volume, no edge farther from its faces than a nanometre; its surface must be the spline within a
nanometre, between the nodes as well, and its light that of the lens.
"""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.metrics import psnr_db
from optics.outline import is_inside
from service.job.report import step
from service.job.spec.optics import ellipse_mm
from tests.benchmarks.pictures import target
from tests.benchmarks.timing import Figure

PIXELS, SIDE_MM, THROW_MM, THICKNESS_MM = 512, 100.0, 250.0, 40.0
MOST_NM, MOST_DB = 1.0, 0.1
CASES = {"square lens": (False, "rectangle"), "round lens": (False, "ellipse"), "mirror": (True, "rectangle")}


def figures() -> Iterator[Figure]:
    if importlib.util.find_spec("OCP") is None:
        yield Figure("cad", 0.0, "nm", "not done: cadquery-ocp-novtk is not installed")
        return
    for name, (is_mirror, outline) in CASES.items():
        yield _case(name, is_mirror, outline)


def _case(name: str, is_mirror: bool, outline: str) -> Figure:
    bench = Bench.centre_on(width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=THROW_MM, refractive_index=1.49)
    corners = np.asarray(ellipse_mm(SIDE_MM, SIDE_MM)) if outline == "ellipse" else None
    bench, wanted = replace(bench, mirror=is_mirror, outline_mm=corners), target("camera", PIXELS)
    lens = design_lens(wanted, LensSettings(bench=bench, skim_mm=0.1)).heightfield
    pieces = step.step_pieces(lens, thickness_mm=THICKNESS_MM, outline=outline)
    with tempfile.TemporaryDirectory() as folder:
        text = b"".join(pieces)
        file_name, data = step.step_file([text])
        path = Path(folder) / "lens.step"
        path.write_bytes(text)
        solid = _read(path)
    off_nm, read = _deviation(solid, lens)
    volume = _volume_share(solid, lens, outline)
    light = [simulate_caustic(one, bench, pixels=(PIXELS, PIXELS)).irradiance for one in (lens, read)]
    scores = [psnr_db(one, wanted) for one in light]
    faults = [
        *["not one closed valid solid"] * (not _is_valid(solid)),
        *[f"edges up to {_edges_nm(solid):.2f} nm off"] * (_edges_nm(solid) > MOST_NM),
        *[f"{off_nm:.3f} nm off"] * (off_nm > MOST_NM),
        *[f"volume off by {volume:.2g}"] * (abs(volume) > 1e-3),
        *[f"light off by {scores[1] - scores[0]:.3f} dB"] * (abs(scores[1] - scores[0]) > MOST_DB),
        *[f"{len(data)} bytes"] * (len(data) > step.MOST_BYTES),
    ]
    said = f"{file_name}, {len(data) / 1e6:.1f} MB, {lens.x_mm.size} points, edges {_edges_nm(solid):.2f} nm"
    said += f", light {scores[0]:.2f} and {scores[1]:.2f} dB"
    return Figure(f"OpenCascade, {name}", off_nm, "nm", f"BROKEN: {', '.join(faults)}" if faults else said)


def _read(path: Path) -> Any:
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    return reader.OneShape()


def _is_valid(solid: Any) -> bool:
    from OCP.BRepCheck import BRepCheck_Analyzer
    from OCP.TopAbs import TopAbs_ShapeEnum

    kind = TopAbs_ShapeEnum.TopAbs_SOLID
    return solid.ShapeType() == kind and _has_closed_shells(solid) and BRepCheck_Analyzer(solid).IsValid()


def _has_closed_shells(solid: Any) -> bool:
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_ShapeEnum

    return all(BRep_Tool.IsClosed_s(shell) for shell in _parts(solid, TopAbs_ShapeEnum.TopAbs_SHELL))


def _parts(solid: Any, kind: Any) -> Iterator[Any]:
    from OCP.TopExp import TopExp_Explorer

    explorer = TopExp_Explorer(solid, kind)
    while explorer.More():
        yield explorer.Current()
        explorer.Next()


def _edges_nm(solid: Any) -> float:
    """The greatest distance of an edge from its faces, as OpenCascade has found it; it starts from 0.1 nm."""
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopoDS import TopoDS

    edges = _parts(solid, TopAbs_ShapeEnum.TopAbs_EDGE)
    return max(1e6 * BRep_Tool.Tolerance_s(TopoDS.Edge(edge)) for edge in edges)


def _deviation(solid: Any, lens: Heightfield) -> tuple[float, Heightfield]:
    """The greatest deviation from the spline [nm], at nodes and between them, and the lens as it was read."""
    from OCP.BRep import BRep_Tool
    from OCP.gp import gp_Pnt
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopoDS import TopoDS

    faces = (TopoDS.Face(face) for face in _parts(solid, TopAbs_ShapeEnum.TopAbs_FACE))
    surfaces = [BRep_Tool.Surface_s(face) for face in faces]
    (surface,) = (one for one in surfaces if type(one).__name__ == "Geom_BSplineSurface")
    point, z_mm = gp_Pnt(), np.empty_like(lens.z_mm)
    worst_mm = 0.0
    for shift in (0.0, 0.37):
        x, y = (np.minimum(axis + shift * step_mm, axis[-1]) for axis, step_mm in
                ((lens.x_mm, lens.dx_mm), (lens.y_mm, lens.dy_mm)))  # fmt: skip
        found = np.empty((y.size, x.size, 3))
        for j, v in enumerate(y.tolist()):
            for i, u in enumerate(x.tolist()):
                surface.D0(u, v, point)
                found[j, i] = point.X(), point.Y(), point.Z()
        exact = lens.spline().heights_mm(found[..., 0], found[..., 1])
        worst_mm = max(worst_mm, float(np.abs(found[..., 2] - exact).max()))
        z_mm = found[..., 2] if shift == 0.0 else z_mm
    return 1e6 * worst_mm, replace(lens, z_mm=z_mm)


def _volume_share(solid: Any, lens: Heightfield, outline: str) -> float:
    """The volume that OpenCascade finds over ours, less 1: a midpoint sum over the outline."""
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    found = GProp_GProps()
    BRepGProp.VolumeProperties_s(solid, found)
    x, y = ((np.arange(2000) + 0.5) / 2000 * axis[-1] for axis in (lens.x_mm, lens.y_mm))
    height = THICKNESS_MM + lens.spline().heights_mm(x[None, :], y[:, None])
    if outline == "ellipse":
        height *= is_inside(np.asarray(ellipse_mm(lens.width_mm, lens.height_mm)), x, y)
    return float(found.Mass() / (height.mean() * lens.width_mm * lens.height_mm) - 1.0)
