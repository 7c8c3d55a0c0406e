"""Pass keys, pictures of the report and fields of the page are added in three files at most: each test adds one, in a
copy of the program.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from service.job.spec.model import JobSpec
from tests.adding import TOP, copy_tree, run_in_copy

_KEY = "slot_feed_share"
_PASS_KEY = {
    "cam/passes.py": ("    spindle_rpm: float\n", f"    spindle_rpm: float\n    {_KEY}: float = 0.5\n"),
    "service/job/spec/cutting.py": (
        "    flute_length_mm: Annotated[",
        f'    {_KEY}: Annotated[float, Field(ge=0.1, le=1), shown("Feed in a slot")] = 0.5\n'
        "    flute_length_mm: Annotated[",
    ),
    "cam/program.py": ("cut(first, SLOT_FEED * ", f"cut(first, spec.{_KEY} * "),
}
_A_PASS = """
from service.processes.kernel_cache import use_current_kernels
use_current_kernels()
import json, sys
import numpy as np
from cam.posts.dialects import POSTS
from cam.program import generate_parts
from cam.surface.stock_grid import StockGrid
from optics.heightfield import Heightfield
from service.errors import SpecError
from service.job.spec.loading import resolve_job, validate_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import cam_passes_of, cam_stock_of
from service.job.stages.table import stage_key

def job_with(share):
    row = {"radius_mm": 1.0, "pitch_mm": 0.5, "step_down_mm": 2.0, "feed_mm_per_min": 1000.0, KEY: share}
    lens = {"width_mm": 4.0, "height_mm": 4.0}
    return resolve_job(base={"optics": lens, "stock": {"margin_mm": 2.0}, "passes": [row]})

def key_of(job, stage):
    return stage_key(stage, job, image_sha256="a", image_name="a.png", outputs={})

try:
    job_with(2.0)
except SpecError as error:
    refusal = str(error)
job, other = job_with(0.25), job_with(0.5)
x_mm = np.linspace(0.0, 4.0, 17)
lens = Heightfield(x_mm=x_mm, y_mm=x_mm, z_mm=-0.5 - 0.01 * x_mm[None, :] * x_mm[:, None])
stock = cam_stock_of(job.spec)

def program_of(job):
    (spec,) = cam_passes_of(job.spec)
    return b"".join(next(generate_parts(lens, spec, stock, stock_top=StockGrid.block(stock, 0.2), post=POSTS["grbl"])))

print(json.dumps({
    "row": JobSpec.model_json_schema()["$defs"]["PassRow"]["properties"][KEY],
    "refusal": refusal,
    "anew": [stage for stage in ("map", "pass-1") if key_of(job, stage) != key_of(other, stage)],
    "programs": [program_of(one).decode() for one in (job, other)],
}))
"""

_TONES = "tones.png"
_DRAWING = '''
"""How much of a picture has which tone."""

import numpy as np

from service.job.report.figures.base import Array
from service.job.picture.light_png import picture_png


def tones_png(picture: Array) -> bytes:
    """Draw the histogram of a picture's light: a column for each of sixteen tones."""
    counts, _ = np.histogram(picture, 16)
    return picture_png((counts[None, :] > counts.max() * np.linspace(1, 0, 16)[:, None]).astype(float), white=1.0)
'''
_PICTURE = {
    "service/job/report/pictures.py": (
        "PICTURES = (\n",
        "PICTURES = (\n"
        f'    ReportPicture(name="{_TONES}", part="lens", title="T", caption=Phrase("Its tones."), shown="page"),\n',
    ),
    "service/job/report/figures/tones.py": _DRAWING,
    "service/job/stages/lens.py": (
        "        context.draw(TARGET_PICTURE, lambda: picture_png(seen, white=white))\n",
        "        context.draw(TARGET_PICTURE, lambda: picture_png(seen, white=white))\n"
        "        from service.job.report.figures.tones import tones_png\n"
        f'        context.draw("{_TONES}", lambda: tones_png(seen))\n',
    ),
}
_A_JOB = """
from service.processes.kernel_cache import use_current_kernels
use_current_kernels()
import json, sys
from pathlib import Path
from service.job.files import is_known
from service.job.pipeline import design
from service.job.spec.loading import resolve_job
from service.progress import QuietReporter
from service.server.api.routes.page import MADE

small = ("image.pixels=16", "optics.width_mm=4", "optics.height_mm=4", "optics.corrections=0")
design(Path("examples/logo.png"), Path("out"), resolve_job(overrides=small), reporter=QuietReporter())
_, pictures = MADE["job/report_pictures.js"]
print(json.dumps({
    "file": (Path("out") / sys.argv[1]).read_bytes()[1:4].decode(),
    "known": is_known(sys.argv[1]),
    "sheet": (Path("out") / "report.html").read_text(),
    "page": [picture for picture in pictures() if picture["name"] == sys.argv[1]],
}))
"""

_FIELD = {
    "service/job/spec/optics.py": (
        "    light: LightSpec = LightSpec()\n",
        "    wall_tilt_deg: Annotated[\n"
        '        float, Field(ge=-60, le=60), shown("Tilt of the wall", "Its upper edge to you.", card="lens")\n'
        "    ] = 0.0\n"
        "    light: LightSpec = LightSpec()\n",
    ),
}
_THE_FORM = """
import json
from service.server.api.routes.page import MADE
name, schema = MADE["new/spec_schema.js"]
print(json.dumps(schema()["$defs"]["OpticsSpec"]["properties"]["wall_tilt_deg"]))
"""


def run(folder: Path, program: str, *arguments: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(run_in_copy(folder, program, *arguments))
    return found


def test_a_pass_key_reaches_the_form_the_key_of_its_stage_and_the_program(tmp_path: Path) -> None:
    told = run(copy_tree(tmp_path / "copy", _PASS_KEY), _A_PASS.replace("KEY", repr(_KEY)))
    assert told["row"]["title"] == "Feed in a slot"
    assert (told["row"]["minimum"], told["row"]["maximum"], told["row"]["default"]) == (0.1, 1, 0.5)
    assert f"passes.0.{_KEY}" in told["refusal"] and "from 0.1 to 1" in told["refusal"]
    assert told["anew"] == ["pass-1"]
    quarter, half = (re.findall(r"F(\d+)", program) for program in told["programs"])
    assert "250" in quarter and "250" not in half


@pytest.mark.thorough
def test_a_picture_of_the_report_is_in_the_folder_on_the_sheet_and_on_the_page(tmp_path: Path) -> None:
    told = run(copy_tree(tmp_path / "copy", _PICTURE), _A_JOB, _TONES)
    assert told["file"] == "PNG" and told["known"]
    assert f'<img src="{_TONES}"' in told["sheet"] and "Its tones." in told["sheet"]
    assert [(row["title"], row["caption"], row["shown"]) for row in told["page"]] == [("T", "Its tones.", "page")]


@pytest.mark.thorough
def test_a_field_of_the_spec_brings_its_words_to_the_page(tmp_path: Path) -> None:
    """What the page makes of them: tests/page/test_new_job.py."""
    told = run(copy_tree(tmp_path / "copy", _FIELD), _THE_FORM)
    assert (told["title"], told["description"], told["unit"]) == ("Tilt of the wall", "Its upper edge to you.", "°")
    assert (told["minimum"], told["maximum"], told["default"]) == (-60, 60, 0.0)
    assert told["form"] == {"card": "lens"}


def test_the_page_s_form_lists_no_key_itself() -> None:
    text = (TOP / "service" / "page" / "new" / "fields.js").read_text(encoding="utf-8")
    tables = [JobSpec.model_json_schema(), *JobSpec.model_json_schema()["$defs"].values()]
    keys = {key for table in tables for key in table["properties"] if "_" in key}
    assert len(keys) > 40
    assert not [key for key in keys if key in text]


def test_every_key_has_words_for_the_form_beside_it_or_no_row() -> None:
    """A key without them would stand there under a name that its code has made."""
    schema = JobSpec.model_json_schema()
    shown = {
        name: table
        for name, table in schema["$defs"].items()
        if name not in ("FaceSpec", "CutOutSpec", "ClampSpec", "LedSpec")
    }
    bare = {
        f"{name}.{key}"
        for name, table in shown.items()
        for key, told in table["properties"].items()
        if "form" not in told and "$ref" not in told
    }
    tables = {"LightSpec.profile", "StockSpec.face", "StockSpec.cut_out", "StockSpec.clamps"}
    assert bare == tables
