"""Adding something is local: each kind of thing is added to a copy of the program, in the files that ARCHITECTURE.md
names for it, and is then there for whoever needs it."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from machines.gcode.dialects import DIALECTS, RML
from optics.light import LIGHT_KINDS
from tests.adding import PACKAGES, TOP, copy_tree, run_in_copy

LIGHT_TABLES = {"optics/light.py", "optics/spectrum.py", "service/job/spec/light.py"}
"""With the spectra, one of which is the sun's."""
DIALECT_TABLES = {
    "cam/posts/dialects.py",
    "cam/posts/post.py",
    "cam/reading/gcode_languages.py",
    "machines/gcode/dialects.py",
}

SCHEMA = """
import json
from service.job.spec.loading import resolve_job
from service.job.spec.model import JobSpec

def choices(section, key):
    return {one["const"]: one for one in JobSpec.model_json_schema()["$defs"][section]["properties"][key]["oneOf"]}
"""

ICE = """ICE = Material(
    name="ice",
    label="ice",
    block=Phrase("clear ice, frozen slowly"),
    refractive_index=1.31,
    density_g_per_cm3=0.92,
    advice="Cold.",
    sources=("a test",),
    cutting=(
        CuttingData(
            radius_mm=3.0, flutes=2, spindle_rpm=10000, feed_mm_per_tooth=0.1, chip_mm=(0.02, 0.2), step_down_mm=2.0,
            plunge_share=0.5,
        ),
    ),
)

MATERIALS: dict[str, Material] = {
    material.name: material for material in (ICE, PMMA, PMMA_EXTRUDED, POLYCARBONATE, ALUMINIUM, BRASS)
}
"""


def test_a_material_is_added_in_one_file(tmp_path: Path) -> None:
    """The passes' feeds and the index are its own, those of a plan too, and the set-up sheet says what to buy."""
    old = """MATERIALS: dict[str, Material] = {
    material.name: material for material in (PMMA, PMMA_EXTRUDED, POLYCARBONATE, ALUMINIUM, BRASS)
}
"""
    copy_tree(tmp_path, {"cam/materials.py": (old, ICE)})
    program = (
        SCHEMA
        + """
from service.job.planning.planner import shop_of
from service.job.report.setup_sheet import describe_setup, render_page

jobs = [resolve_job(overrides=["preset=draft", f"stock.material={name}"]) for name in ("pmma", "ice")]
print(json.dumps({
    "title": choices("StockSpec", "material")["ice"]["title"],
    "index": [job.spec.optics.refractive_index for job in jobs],
    "spindle_rpm": [job.spec.passes[0].spindle_rpm for job in jobs],
    "planned": shop_of(jobs[1]).material.name,
    "sheet": render_page(describe_setup({}, spec=jobs[1].spec.plain())),
}))
"""
    )
    found = json.loads(run_in_copy(tmp_path, program))
    assert found["title"] == "ice" and found["planned"] == "ice"
    assert found["spindle_rpm"][1] == 10000 != found["spindle_rpm"][0]
    assert found["index"] == [1.49, 1.31]
    assert "clear ice, frozen slowly" in found["sheet"]


@pytest.mark.thorough
def test_a_kind_of_light_is_added_in_two_files(tmp_path: Path) -> None:
    """What it does to light in one, what a person reads of it in the other: a disc of directions, a little smaller than
    the sun's."""
    point = """    "point": LightKind(is_point=True, radius=lambda light: light.size_mm / 2),
"""
    lamp = """        figures=("distance_mm", "size_mm"),
    ),
"""
    copy_tree(
        tmp_path,
        {
            "optics/light.py": (
                point,
                point + '    "moon": LightKind(is_point=False, radius=lambda light: math.radians(0.5) / 2),\n',
            ),
            "service/job/spec/light.py": (
                lamp,
                lamp
                + '    "moon": LightWords(label="Moon", hint="faint", describe=lambda light, mirror: "Full moon."),\n',
            ),
        },
    )
    program = (
        SCHEMA
        + """
import numpy as np
from service.job.report.optics import light_sentences
from service.job.spec.lens_task import bench_of, source_spread_mm

def width_mrad(kind):
    spec = resolve_job(overrides=[f"optics.light.kind={kind}", "optics.surface=mirror"]).spec
    beams = bench_of(spec).bundle(200)
    return 1000 * np.ptp([beam.x for beam in beams]), source_spread_mm(spec.plain(), 100.0)

spec = resolve_job(overrides=["optics.light.kind=moon"]).spec
print(json.dumps({
    "choice": choices("LightSpec", "kind")["moon"],
    "sentences": light_sentences(spec.plain()),
    "widths": {kind: width_mrad(kind) for kind in ("collimated", "sun", "moon")},
}))
"""
    )
    found = json.loads(run_in_copy(tmp_path, program))
    assert (found["choice"]["title"], found["choice"]["description"]) == ("Moon", "faint")
    assert found["sentences"][0] == "Full moon."
    (parallel, no_spread), (sun, spread_sun), (moon, spread_moon) = found["widths"].values()
    assert parallel == 0.0 and no_spread is None
    assert 0.9 * 8.7 < moon < 0.96 * sun  # half a degree is 8.7 mrad; no beam stands on the rim
    assert 0.87 < spread_moon < spread_sun


def named(names: Iterable[str]) -> Iterator[str]:
    """Each place where a module of the program or of the page writes one of them as a text or as a key."""
    either = "|".join(map(re.escape, names))
    quoted = re.compile(rf"""["'`]({either})["'`]|\b({either}):""")
    for path in (path for package in PACKAGES for path in (TOP / package).rglob("*.js")):
        if path.suffix == ".js" and quoted.search(path.read_text("utf-8")):
            yield path.relative_to(TOP).as_posix()
    for path in (path for package in PACKAGES for path in (TOP / package).rglob("*.py")):
        nodes = ast.walk(ast.parse(path.read_text("utf-8")))
        if any(isinstance(node, ast.Constant) and node.value in names for node in nodes):
            yield path.relative_to(TOP).as_posix()


@pytest.mark.parametrize(
    ("names", "tables"),
    [
        (tuple(LIGHT_KINDS), LIGHT_TABLES),
        ((*(name for name, one in DIALECTS.items() if not one.is_grbl), RML), DIALECT_TABLES),
    ],
    ids=["light", "dialect"],
)
def test_a_kind_is_named_in_its_tables_only(names: tuple[str, ...], tables: set[str]) -> None:
    """Elsewhere a question about a kind is asked of its row, so that a new one has an answer; on the page, too. The
    controls of GRBL's family are named by their links as well, whose firmware tells them apart."""
    assert set(named(names)) == tables


def test_a_dialect_is_added_in_three_files_that_share_nothing(tmp_path: Path) -> None:
    """The post, the reader that does not trust it, and what a mill's side takes: a job for a mill that speaks it is
    accepted, a program is written, read back and taken line by line."""
    post = "_ALL: tuple[Dialect, ...] = ("
    reader = '        Language(name="rml-1", kind="rml", digit_mm=0.01),\n'
    mill = '        Dialect(name="grbl", title="GRBL",'
    copy_tree(
        tmp_path,
        {
            "cam/posts/dialects.py": (
                post,
                "MACH = Post(\n"
                '    name="mach", suffix=".tap", start=("G21G90G94G17G54", "G0Z{safe_z}"),\n'
                '    spin=("M3S{rpm}", "G4P{dwell_s}"), end=("G0Z{safe_z}", "M5", "M30"),\n'
                '    coolant={"mist": "M7"}, z_decimals=4,\n'
                ")\n"
                "_ALL: tuple[Dialect, ...] = (MACH, ",
            ),
            "cam/reading/gcode_languages.py": (
                reader,
                reader + '        Language(name="mach", most_decimals=4, digit_mm=1e-4),\n',
            ),
            "machines/gcode/dialects.py": (
                mill,
                '        Dialect(name="mach", title="Mach3", own=(*_NOT_HERE, *_NO_CHANGER)),\n' + mill,
            ),
        },
    )
    profiles = tmp_path / "machines" / "profiles"
    (profiles / "shed.toml").write_text('name = "shed"\nextends = "linuxcnc"\ndialect = "mach"\ncoolant = "mist"\n')
    program = """
import json
from cam.moves import cut, rapid
from cam.posts.dialects import POSTS
from cam.posts.writers import create_writer
from cam.reading.gcode import LANGUAGES, ProgramError, read_parts
from machines.gcode.interpreter import Interpreter
from service.errors import SpecError
from service.job.spec.loading import resolve_job
from service.job.spec.resolve import setup_of

job = resolve_job(overrides=["machine.profile=shed"])
writer = create_writer(POSTS[job.machine.dialect])
path = [rapid((0, 0, 5)), cut([(0, 0, 0.12345), (2, 1, -0.5)], 300), rapid((2, 1, 5))]
text = writer.start(("tiny",), rpm=12000, safe_z_mm=5.0, setup=setup_of(job.machine, tool=1))
text += b"".join(piece for part in path for piece in writer.write(part)) + writer.end(safe_z_mm=5.0)
batches = list(read_parts([[text]], LANGUAGES["mach"]))
mill = Interpreter(dialect="mach")
steps = [mill.take(line) for line in text.splitlines()]
faults = []
for line in ("G1X0.00001Y0F1", "G5.1Q1"):
    try:
        list(read_parts([[f"{line}\\n".encode()]], LANGUAGES["mach"]))
    except ProgramError as error:
        faults.append(str(error))
try:
    resolve_job(overrides=["machine.profile=shed", "machine.coolant=flood"])
except SpecError as error:
    faults.append(str(error))
print(json.dumps({
    "text": text.decode(), "ended": batches[-1].ended, "last": batches[-1].points_mm.tolist(), "faults": faults,
    "state": [mill.state.coolant, *mill.state.position_mm], "cuts": sum(step.kind == "feed" for step in steps),
}))
"""
    found = json.loads(run_in_copy(tmp_path, program))
    assert "M7\n" in found["text"] and "Z0.1235" in found["text"]  # four decimals, GRBL's post has five
    assert found["ended"] and [2.0, 1.0, -0.5] in found["last"]
    assert found["state"][1:] == [2.0, 1.0, 5.0] and found["cuts"] == 2
    assert len(found["faults"]) == 3 and "'none' or 'mist' in dialect 'mach'" in found["faults"][2]


@pytest.mark.thorough
def test_a_cutter_s_shape_is_added_in_one_file(tmp_path: Path) -> None:
    """A bull-nose faces a block: rows lie apart and leave cusps as its corner has them, and the check cuts with it."""
    known = "in (end_mill(0.0), BALL)}"
    bull = 'CutterShape(name="bull-nose", corner_share=0.5, pitch_share=4 / 3)'
    copy_tree(tmp_path, {"cam/cutters.py": (known, f"in (end_mill(0.0), BALL, {bull})}}")})
    program = (
        SCHEMA
        + """
import numpy as np
from cam.around.check import check_facing
from cam.around.check import CheckedMill
from cam.around.paths import make_facing_paths
from cam.parts import PassFrame, programs
from cam.posts.dialects import GRBL
from cam.surface.stock_grid import StockGrid
from cam.duration import Kinematics
from service.job.spec.resolve import cam_stock_of, facing_task_of

def face(shape):
    block = ["optics.width_mm=8", "optics.height_mm=8", "stock.margin_mm=2", "stock.face.above_mm=0.5"]
    job = resolve_job(overrides=["preset=draft", *block, f"stock.face.tool={shape}"])
    facing, stock, mill = facing_task_of(job.spec), cam_stock_of(job.spec), job.machine
    paths = make_facing_paths(facing, stock, safe_z_mm=mill.safe_z_mm)
    frame = PassFrame(
        remarks=(), rpm=facing.spindle_rpm, plunge_mm_per_min=300, safe_z_mm=mill.safe_z_mm, aperture_mm=(8, 8)
    )
    texts = [list(text) for text in programs(paths, GRBL, frame)]
    grid = StockGrid.block(stock, 0.1)
    raw = StockGrid(x0_mm=grid.x0_mm, y0_mm=grid.y0_mm, cell_mm=0.1, top_mm=np.full(grid.top_mm.shape, 0.5))
    checked = CheckedMill(kinematics=Kinematics.of(mill), safe_z_mm=mill.safe_z_mm)
    verdict = check_facing(texts, facing, stock=stock, stock_top=raw, mill=checked)
    return facing.pitch_mm, facing.cusp_mm, verdict.left_um / 1000, verdict.faults

print(json.dumps({"choices": list(choices("FaceSpec", "tool")), "faced": [face("flat"), face("bull-nose")]}))
"""
    )
    found = json.loads(run_in_copy(tmp_path, program))
    assert found["choices"] == ["flat", "ball", "bull-nose"]
    (_, flat_cusp, flat_left, flat_faults), (pitch, cusp, left, faults) = found["faced"]
    assert flat_faults == faults == [] and flat_cusp == flat_left == 0
    assert pitch == 4.0  # of the usual radius of 3 mm, half of which is flat: 1 mm lies between two rows
    assert cusp - 0.02 < left <= cusp < 0.09  # cells of 0.1 mm may stand half of that beside a ridge
