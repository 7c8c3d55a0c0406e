"""What the page draws is offered by ranges, and stays out of folders and archives that a person takes home."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.client.download import files_of
from service.job.files import is_drawing, is_known, is_program
from tests.service.job.page_data.paths import batch_of, cut_in, header, level, rows, written
from tests.service.server.api.server import ApiServer, api_server

DRAWINGS = ("surface.bin", "thumbnail.png", "thumbnail-as-milled.png", "pass-1.path", "pass-12.path", "report-de.html")


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
