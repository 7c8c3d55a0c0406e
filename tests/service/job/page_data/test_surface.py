"""surface.bin against the lens; what the page draws is offered by ranges, and stays out of folders and archives that a
person takes home.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from optics.heightfield import Heightfield
from service.client.download import files_of
from service.job.files import is_drawing, is_known, is_program, make_header_line
from service.job.page_data.surface import surface_bytes
from tests.service.job.page_data.paths import batch_of, cut_in, header, level, rows, split_header, written
from tests.service.server.api.server import ApiServer, api_server

WIDTH_MM, HEIGHT_MM = 30.0, 20.0

DRAWINGS = ("surface.bin", "thumbnail.png", "thumbnail-as-milled.png", "pass-1.path", "pass-12.path", "report-de.html")


@pytest.fixture(scope="module")
def lens() -> Heightfield:
    """A dome off the middle, on a grid of its own: no mirror of it looks the same."""
    y, x = np.mgrid[0:81, 0:121] / 4.0
    z = -1.0 - 0.02 * ((x - 12) ** 2 + (y - 8) ** 2) / 2
    return Heightfield.on_aperture(z, width_mm=WIDTH_MM, height_mm=HEIGHT_MM)


@pytest.mark.parametrize("length", range(20))
def test_arrays_begin_at_a_multiple_of_eight(length: int) -> None:
    line = make_header_line({"name": "a" * length})
    assert len(line) % 8 == 0
    assert line.endswith(b"\n")
    assert split_header(line + b"\n123") == ({"name": "a" * length}, len(line))


def test_the_surface_is_the_lens_to_its_step(lens: Heightfield) -> None:
    data = surface_bytes(lens, thickness_mm=20.0, margin_mm=5.0, outline_mm=None)
    facts, start = split_header(data)
    z = np.frombuffer(data, "<u2", offset=start).reshape(facts["ny"], facts["nx"])
    assert (facts["nx"], facts["ny"]) == (257, 172)
    x = facts["x0_mm"] + facts["dx_mm"] * np.arange(facts["nx"])
    y = facts["y0_mm"] + facts["dy_mm"] * np.arange(facts["ny"])
    assert (x[-1], y[-1]) == (pytest.approx(WIDTH_MM), pytest.approx(HEIGHT_MM))
    wanted = -1.0 - 0.02 * ((x[None, :] - 12) ** 2 + (y[:, None] - 8) ** 2) / 2
    assert np.abs(facts["z0_mm"] + facts["dz_mm"] * z - wanted).max() <= 0.51 * facts["dz_mm"]


def test_a_flat_lens_has_no_steps() -> None:
    flat = Heightfield.on_aperture(np.full((9, 9), -0.5), width_mm=10.0, height_mm=10.0)
    facts, start = split_header(
        data := surface_bytes(flat, thickness_mm=9.0, margin_mm=1.0, outline_mm=[[0, 0], [1, 0]])
    )
    assert (facts["z0_mm"], facts["dz_mm"]) == (pytest.approx(-0.5), pytest.approx(0.0, abs=1e-15))
    assert len(data) == start + 2 * 257 * 257


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    with api_server(tmp_path_factory.mktemp("drawn") / "data") as running:
        yield running


@pytest.mark.parametrize(
    "name", [*DRAWINGS, "pass-1-rough.nc", "lens.stl", "report.html", "pass-1.pathx", "a-pass-1.path"]
)
def test_names_tell_drawings_from_what_a_person_wants(name: str) -> None:
    assert is_drawing(name) == (name in DRAWINGS)
    assert not (is_drawing(name) and is_program(name))
    assert is_known(name) or not is_drawing(name)


def test_a_chunk_is_read_by_a_range_of_the_file(server: ApiServer, tmp_path: Path) -> None:
    """As the page does it: the header, an index, and of the points no more than are seen."""
    data = written(tmp_path, cut_in(batch_of(rows(200)), 3))
    job = server.submit()["id"]
    server.put_artifact(job, "pass-1.path", data, stage="check")
    address = f"/v1/jobs/{job}/artifacts/pass-1.path"

    def part(start: int, count: int) -> bytes:
        answer = server.client.get(address, headers={"Range": f"bytes={start}-{start + count - 1}"})
        assert answer.status_code == 206
        return answer.content

    facts = header(part(0, 4096))["levels"][-1]
    row = np.frombuffer(part(facts["index_offset_bytes"] + 48 * 3, 48), "<u4", 2)
    raw = np.frombuffer(part(facts["offset_bytes"] + 8 * int(row[0]), 8 * int(row[1])), "<u2").reshape(-1, 4)
    whole = level(data, -1)
    assert raw.shape == (whole.index[3]["count"], 4)
    assert ((raw[:, 3] & 2 > 0) == whole.hidden[row[0] : row[0] + row[1]]).all()


def test_archives_and_folders_are_without_them(server: ApiServer) -> None:
    job = server.submit()["id"]
    for name in (*DRAWINGS, "lens.stl"):
        server.put_artifact(job, name, name.encode())
    archive = server.client.get(f"/v1/jobs/{job}/archive.zip")
    with zipfile.ZipFile(io.BytesIO(archive.content)) as opened:
        assert opened.namelist() == ["lens.stl"]

    class Asked:
        def get(self, path: str) -> object:
            return server.client.get(path).json()

    assert [file.name for file in files_of(Asked(), job)] == ["lens.stl"]  # type: ignore[arg-type]
    assert [file.name for file in files_of(Asked(), job, ["surface.bin"])] == ["surface.bin"]  # type: ignore[arg-type]
