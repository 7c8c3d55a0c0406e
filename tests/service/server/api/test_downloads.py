"""Files of a job over HTTP: whole, in parts, conditionally, and all in one archive."""

from __future__ import annotations

import io
import os
import zipfile

import pytest

from tests.service.server.api.server import ApiServer, png, problem, sha256

CONTENT = os.urandom(3_000_000)
PROGRAM = b"G21 G90\nM2\n" * 1000


@pytest.fixture(scope="module")
def job(server: ApiServer) -> str:
    """Address of a job with a few files."""
    job_id = server.submit()["id"]
    server.put_artifact(job_id, "heightfield.npz", CONTENT)
    server.put_artifact(job_id, "report.html", b"<p>sheet</p>", stage="report")
    server.put_artifact(job_id, "empty.log", b"")
    server.put_artifact(job_id, ".stock-1.npz", b"between stages")
    server.put_artifact(job_id, "pass-1-rough.nc", PROGRAM, stage="pass-1")
    server.put_artifact(job_id, "pass-2-finish.nc", PROGRAM[::-1], stage="pass-2")
    server.put_artifact(job_id, "pass-1.log", b"said", stage="pass-1")
    return f"/v1/jobs/{job_id}"


def test_whole_file_and_its_headers(server: ApiServer, job: str) -> None:
    got = server.client.get(f"{job}/artifacts/heightfield.npz")
    assert got.status_code == 200 and got.content == CONTENT
    expected = {
        "etag": f'"{sha256(CONTENT)}"',
        "content-length": str(len(CONTENT)),
        "accept-ranges": "bytes",
        "content-disposition": 'attachment; filename="heightfield.npz"',
        "content-type": "application/zip",
    }
    assert {key: got.headers[key] for key in expected} == expected
    head = server.client.head(f"{job}/artifacts/heightfield.npz")
    assert head.status_code == 200 and not head.content
    assert {key: head.headers[key] for key in expected} == expected


@pytest.mark.parametrize(
    ("asked", "start", "end"),
    [("bytes=0-0", 0, 1), ("bytes=100-", 100, None), ("bytes=-100", -100, None), ("bytes=5-10", 5, 11),
     ("BYTES=1000000-2200000", 1_000_000, 2_200_001), ("bytes=2999999-9999999999", 2_999_999, None),
     ("bytes=-99999999", 0, None)],
)  # fmt: skip
def test_a_range_is_exactly_that_part(server: ApiServer, job: str, asked: str, start: int, end: int | None) -> None:
    got = server.client.get(f"{job}/artifacts/heightfield.npz", headers={"Range": asked})
    assert got.status_code == 206 and got.content == CONTENT[start:end]
    first = start if start >= 0 else len(CONTENT) + start
    assert got.headers["content-range"] == f"bytes {first}-{first + len(got.content) - 1}/{len(CONTENT)}"
    head = server.client.head(f"{job}/artifacts/heightfield.npz", headers={"Range": asked})
    assert head.status_code == 200 and head.headers["content-length"] == str(len(CONTENT))  # ranges are of GET only


@pytest.mark.parametrize("asked", ["bytes=3000000-", "bytes=3000000-3000001", "bytes=-0", "bytes=9999999999-"])
def test_a_range_beyond_the_file_is_refused(server: ApiServer, job: str, asked: str) -> None:
    got = server.client.get(f"{job}/artifacts/heightfield.npz", headers={"Range": asked})
    problem(got, 416, "Range")
    assert got.headers["content-range"] == f"bytes */{len(CONTENT)}"


@pytest.mark.parametrize(
    "asked", ["", "bytes", "bytes=", "bytes=-", "lines=1-2", "bytes=a-b", "bytes=9-3", "bytes=0-1,4-5"]
)
def test_what_is_no_single_range_gives_the_whole(server: ApiServer, job: str, asked: str) -> None:
    got = server.client.get(f"{job}/artifacts/report.html", headers={"Range": asked})
    assert got.status_code == 200 and got.content == b"<p>sheet</p>"


def test_a_download_goes_on_only_with_the_same_file(server: ApiServer, job: str) -> None:
    address, tag = f"{job}/artifacts/heightfield.npz", f'"{sha256(CONTENT)}"'
    rest = server.client.get(address, headers={"Range": "bytes=1234567-", "If-Range": tag})
    assert rest.status_code == 206 and CONTENT[:1234567] + rest.content == CONTENT
    for stale in ('"other"', f"W/{tag}", "Sat, 21 Nov 2026 08:00:00 GMT"):
        whole = server.client.get(address, headers={"Range": "bytes=1234567-", "If-Range": stale})
        assert whole.status_code == 200 and len(whole.content) == len(CONTENT)


def test_a_file_that_the_client_has_is_not_sent(server: ApiServer, job: str) -> None:
    for tag in (f'"{sha256(CONTENT)}"', f'"x", W/"{sha256(CONTENT)}"', "*"):
        got = server.client.get(f"{job}/artifacts/heightfield.npz", headers={"If-None-Match": tag})
        assert got.status_code == 304 and not got.content
    got = server.client.get(f"{job}/artifacts/heightfield.npz", headers={"If-None-Match": '"other"'})
    assert got.status_code == 200


def test_an_empty_file_can_be_had(server: ApiServer, job: str) -> None:
    got = server.client.get(f"{job}/artifacts/empty.log")
    assert got.status_code == 200 and got.content == b"" and got.headers["content-length"] == "0"
    problem(server.client.get(f"{job}/artifacts/empty.log", headers={"Range": "bytes=0-"}), 416)


def test_a_report_page_gets_no_rights_here(server: ApiServer, job: str) -> None:
    got = server.client.get(f"{job}/artifacts/report.html")
    assert got.headers["content-security-policy"].startswith("sandbox; default-src 'none'")
    assert got.headers["x-content-type-options"] == "nosniff"


def test_programs_are_offered_once_all_are_checked(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    server.put_artifact(job_id, "pass-1-rough.nc", PROGRAM, stage="pass-1")
    address = f"/v1/jobs/{job_id}"
    for path in ("/programs/1", "/artifacts/pass-1-rough.nc"):
        problem(server.client.get(address + path), 404)
        assert server.client.head(address + path).status_code == 404
    assert server.client.get(f"{address}/artifacts").json() == {"artifacts": []}
    assert server.client.get(address).json()["programs"] == []
    server.put_stage(job_id, "check")
    got = server.client.get(f"{address}/programs/1")
    assert got.content == PROGRAM and got.headers["content-disposition"] == 'attachment; filename="pass-1-rough.nc"'
    assert got.headers["content-type"] == "text/plain; charset=us-ascii"
    assert server.client.head(f"{address}/programs/1").headers["etag"] == f'"{sha256(PROGRAM)}"'
    (program,) = server.client.get(address).json()["programs"]
    assert program["number"] == 1 and program["sha256"] == sha256(PROGRAM) and program["bytes"] == len(PROGRAM)
    assert server.client.get(program["url"]).content == PROGRAM
    problem(server.client.get(f"{address}/programs/2"), 404, "n")
    problem(server.client.get(f"{address}/programs/0"), 422, "n")


def test_a_job_whose_pass_fails_keeps_its_lens_and_offers_no_program(server: ApiServer) -> None:
    """Pass 1 passed its check, pass 2 did not: the mill's rules have not been applied to either."""
    job_id = server.submit()["id"]
    server.put_artifact(job_id, "heightfield.npz", CONTENT, stage="map")
    server.put_artifact(job_id, "pass-1-rough.nc", PROGRAM, stage="pass-1")
    server.put_stage(job_id, "pass-2", "failed")
    server.put_state(job_id, "failed")
    address = f"/v1/jobs/{job_id}"
    assert [row["name"] for row in server.client.get(f"{address}/artifacts").json()["artifacts"]] == ["heightfield.npz"]
    assert server.client.get(f"{address}/artifacts/heightfield.npz").content == CONTENT
    problem(server.client.get(f"{address}/programs/1"), 404)


def test_the_listing_shows_what_is_offered_and_nothing_between_stages(server: ApiServer, job: str) -> None:
    rows = server.client.get(f"{job}/artifacts").json()["artifacts"]
    assert [row["name"] for row in rows] == ["empty.log", "heightfield.npz", "pass-1.log", "report.html"]
    for row in rows:
        assert sha256(server.client.get(row["url"]).content) == row["sha256"]
    problem(server.client.get(f"{job}/artifacts/.stock-1.npz"), 404)


def test_the_archive_holds_every_offered_file_and_is_always_the_same(server: ApiServer, job: str) -> None:
    first, second = (server.client.get(f"{job}/archive.zip") for _ in range(2))
    assert first.status_code == 200 and first.content == second.content
    with zipfile.ZipFile(io.BytesIO(first.content)) as archive:
        assert archive.testzip() is None
        assert archive.namelist() == ["empty.log", "heightfield.npz", "pass-1.log", "report.html"]
        assert archive.read("heightfield.npz") == CONTENT
        assert {entry.compress_type for entry in archive.infolist()} == {zipfile.ZIP_STORED}
    head = server.client.head(f"{job}/archive.zip")
    assert head.status_code == 200 and head.headers["etag"] == first.headers["etag"]
    again = server.client.get(f"{job}/archive.zip", headers={"If-None-Match": first.headers["etag"]})
    assert again.status_code == 304


def test_a_file_that_the_store_lost_is_a_problem_before_anything_is_sent(server: ApiServer) -> None:
    job_id = server.submit()["id"]
    digest = server.put_artifact(job_id, "lens.stl", b"lost" * 100)
    server.services.store.delete(digest)
    problem(server.client.get(f"/v1/jobs/{job_id}/artifacts/lens.stl"), 503)
    problem(server.client.get(f"/v1/jobs/{job_id}/archive.zip"), 503)
    assert server.client.head(f"/v1/jobs/{job_id}/artifacts/lens.stl").status_code == 503


@pytest.mark.parametrize(
    ("picture", "plain", "extended"),
    [
        ("cat.png", "cat", None),
        ("鳥 Ж.png", "_ _", "%E9%B3%A5%20%D0%96"),
        ("קנ.é.png", "__._", "%D7%A7%D7%A0.%C3%A9"),
    ],
)
def test_an_archive_is_named_like_the_picture_in_any_script(
    server: ApiServer, picture: str, plain: str, extended: str | None
) -> None:
    answer = server.client.post("/v1/jobs", files={"image": (picture, png(), "image/png")})
    job = answer.json()
    assert job["name"] == picture
    shown = server.client.head(f"/v1/jobs/{job['id']}/archive.zip").headers["content-disposition"]
    tail = f"-{job['id'][:8]}.zip"
    more = f"; filename*=UTF-8''{extended}{tail}" if extended else ""
    assert shown == f'attachment; filename="{plain}{tail}"{more}'
