"""A finished job as a server tells it, and its files: written as a job writes them, of a surface nobody designed."""

from __future__ import annotations

import copy
import hashlib
import io
import json
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from optics.heightfield import Heightfield
from service.job.page_data.surface import light_bytes, surface_bytes
from service.job.picture.light_png import picture_png, thumbnail_png
from service.job.spec.lens_task import bench_of
from service.job.spec.model import JobSpec
from tests.page.paths import SIDE_MM, Thinned, write_path

PIXELS = 64
# As a server told them of the job of `shop.SMALL_SPEC`; a journey holds them against such a job.
_TOLD: dict[str, Any] = json.loads(Path(__file__).with_name("job.json").read_text(encoding="utf-8"))
# Other answers as the API's document allows them.
_ANSWERS: dict[str, Any] = json.loads(Path(__file__).with_name("canned_answers.json").read_text(encoding="utf-8"))
ESTIMATE_EXAMPLE, PROFILE_EXAMPLE = _ANSWERS["EstimateView"], _ANSWERS["ProfileView"]
LOOK_EXAMPLE, COUPON_EXAMPLE, RUN_EXAMPLE = _ANSWERS["LookView"], _ANSWERS["CouponView"], _ANSWERS["RunView"]
_LEVELS = (Thinned(8, 0.2, 0.4), Thinned(2, 0.1, 0.1), Thinned(1, 0.05, 0.0))
JOB_ID: str = _TOLD["job"]["id"]


def _fill_specs(job: dict[str, Any]) -> None:
    """Add the keys of the spec that are newer than the file, with their defaults."""
    job["spec"] = JobSpec.model_validate(job["spec"]).model_dump(mode="json")
    for row, given in zip(job["report"]["passes"], job["spec"]["passes"], strict=True):
        row["settings"] = given | row["settings"]


_fill_specs(_TOLD["job"])


@cache
def files() -> dict[str, bytes]:
    """Name -> content. What the page only offers to save says its own name."""
    made = {one["name"]: one["name"].encode() for one in _TOLD["artifacts"]}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("pass-1.path", "pass-2.path"):
            path = Path(folder) / name
            write_path(path, side_mm=SIDE_MM, pitch_mm=0.5 if name == "pass-1.path" else 0.1, levels=_LEVELS)
            made[name] = path.read_bytes()
    made |= {name: _chart() for name in made if name.endswith(".png")}
    rows, columns = np.mgrid[:PIXELS, :PIXELS] / PIXELS
    for k, name in enumerate(("target.png", "caustic.png", "caustic-as-milled.png")):
        made[name] = picture_png(1 + np.sin(9 * rows + k) * columns, white=2.0)
    made["thumbnail-as-milled.png"] = made["thumbnail.png"] = thumbnail_png(1 + np.sin(9 * rows) * columns, white=2.0)
    made["surface.bin"] = surface_bytes(_lens(), thickness_mm=40.0, margin_mm=8.0, outline_mm=None)
    bench = bench_of(JobSpec.model_validate(_TOLD["job"]["spec"]))
    made["light.bin"] = light_bytes(_lens(), bench, white=2.0, viewed_from="lens")
    marks = np.array([[0.0, -0.002], [0.0, 0.0], [0.0, 0.002]])
    made["light-as-milled.bin"] = light_bytes(_lens(), bench, white=2.0, viewed_from="lens", slopes=marks)
    return made


def job() -> dict[str, Any]:
    """What GET /v1/jobs/{id} answers; yours to change."""
    found: dict[str, Any] = copy.deepcopy(_TOLD["job"])
    for program in found["programs"]:
        program |= _facts(program["name"])
    return found


def artifacts() -> list[dict[str, Any]]:
    """What GET /v1/jobs/{id}/artifacts lists; yours to change."""
    address = f"/v1/jobs/{JOB_ID}/artifacts/"
    return [one | _facts(one["name"]) | {"url": address + one["name"]} for one in _TOLD["artifacts"]]


def request() -> dict[str, Any]:
    """What GET /v1/jobs/{id}/request answers."""
    return copy.deepcopy(_TOLD["request"])


def plan() -> dict[str, Any]:
    """What the report of a job says whose passes were planned, with two plans to choose from; yours to change."""
    return copy.deepcopy(_TOLD["plan"])


def shape(told: Any) -> Any:
    """What kinds of values stand where, of a JSON value; lists by what they begin with."""
    kinds: dict[type, Callable[[Any], Any]] = {
        dict: lambda table: {key: shape(value) for key, value in table.items()},
        list: lambda row: [shape(one) for one in row[:1]],
        int: lambda _: "number",
        float: lambda _: "number",
    }
    return kinds.get(type(told), lambda one: type(one).__name__)(told)


def _facts(name: str) -> dict[str, Any]:
    content = files()[name]
    return {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}


def _chart() -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (945, 660), (240, 240, 240)).save(file, "PNG")
    return file.getvalue()


def _lens() -> Heightfield:
    x_mm = np.linspace(0.0, SIDE_MM, PIXELS + 1)
    z_mm = -0.5 + 0.3 * np.sin(0.6 * x_mm)[None, :] * np.cos(0.4 * x_mm)[:, None] + 0.01 * x_mm[None, :]
    return Heightfield(x_mm=x_mm, y_mm=x_mm, z_mm=z_mm)
