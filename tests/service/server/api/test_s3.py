"""Artifacts in an S3 bucket: downloads are sent there, everything else works as ever."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.service.server.api.server import ApiServer, api_server, png, sha256
from tests.service.store.conftest import s3_address, s3_urls  # noqa: F401 - fixtures
from tests.waiting import PATIENCE_S

CONTENT = bytes(range(256)) * 4000


@pytest.fixture
def far(tmp_path: Path, s3_urls: Iterator[str]) -> Iterator[ApiServer]:  # noqa: F811
    with api_server(tmp_path / "data", store_url=next(s3_urls)) as running:
        yield running


def test_a_download_is_sent_to_the_bucket_and_the_rest_is_as_ever(far: ApiServer) -> None:
    picture = png()
    job_id = far.submit(image=("a.png", picture))["id"]
    assert far.services.store.head(sha256(picture)).bytes == len(picture) and far.files() == set()
    far.put_artifact(job_id, "lens.stl", CONTENT)
    address = f"/v1/jobs/{job_id}/artifacts/lens.stl"
    answer = far.client.get(address, headers={"Range": "bytes=100-"})
    assert answer.status_code == 307 and answer.headers["etag"] == f'"{sha256(CONTENT)}"'
    fetched = httpx.get(answer.headers["location"], trust_env=False, timeout=PATIENCE_S)
    assert fetched.content == CONTENT
    head = far.client.head(address)
    assert head.status_code == 200 and head.headers["content-length"] == str(len(CONTENT))
    assert far.client.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    archive = far.client.get(f"/v1/jobs/{job_id}/archive.zip")
    with zipfile.ZipFile(io.BytesIO(archive.content)) as packed:
        assert packed.read("lens.stl") == CONTENT


@pytest.mark.parametrize("headers", [{"Accept": "text/html,*/*;q=0.8"}, {"Sec-Fetch-Mode": "navigate"}])
def test_a_browser_gets_the_file_under_its_name(far: ApiServer, headers: dict[str, str]) -> None:
    """The bucket would call it by its hash; others are told the name with the address (`curl -L -OJ` keeps it)."""
    job_id = far.submit()["id"]
    far.put_artifact(job_id, "lens.stl", CONTENT)
    address, named = f"/v1/jobs/{job_id}/artifacts/lens.stl", 'attachment; filename="lens.stl"'
    answer = far.client.get(address, headers=headers)
    assert (answer.status_code, answer.content) == (200, CONTENT)
    assert answer.headers["content-disposition"] == named
    sent = far.client.get(address)
    assert (sent.status_code, sent.headers["content-disposition"]) == (307, named)


@pytest.mark.parametrize("name", ["report.html", "caustic.png", "report.json"])
def test_a_page_and_its_pictures_stay_on_one_server(far: ApiServer, name: str) -> None:
    """From a bucket they would come as bytes to save, and from a place that the page's policy refuses."""
    job_id = far.submit()["id"]
    far.put_artifact(job_id, name, b"x" * 100)
    answer = far.client.get(f"/v1/jobs/{job_id}/artifacts/{name}")
    assert (answer.status_code, answer.content) == (200, b"x" * 100)
    assert answer.headers["content-disposition"] == f'inline; filename="{name}"'
