"""Jobs over HTTP: submit, list, look, cancel, retry, delete."""

from __future__ import annotations

import json
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.job.spec.loading import resolve_spec
from service.server.api.job_views import make_view
from service.server.database.records import Job, JobState
from tests.service.server.api.server import ApiServer, api_server, png, problem, sha256

UNKNOWN_ID = "d0c2cc5f-d592-4b4d-8554-150a7f903e7c"  # one for all processes: it is part of tests' names
SPEC = {"preset": "draft", "optics": {"width_mm": 40, "height_mm": 40}}


def test_a_picture_becomes_a_durable_queued_job(server: ApiServer) -> None:
    picture = png()
    answer = server.client.post(
        "/v1/jobs", files={"image": ("my cat.png", picture)}, data={"spec": json.dumps(SPEC), "priority": "high"}
    )
    job = answer.json()
    assert answer.status_code == 202
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}" and answer.headers["retry-after"] == "1"
    assert job["state"] == "queued" and job["name"] == "my cat.png" and job["priority"] == "high"
    assert job["image"] == {"sha256": sha256(picture), "bytes": len(picture)}
    assert job["spec"]["optics"]["width_mm"] == 40 and job["spec"]["passes"]  # resolved: nothing is left open
    assert job["queue_position"] == 1 and job["programs"] == [] and job["report"] is None
    assert [stage["state"] for stage in job["stages"]] == ["waiting"] * len(job["stages"])
    assert sum(stage["share"] for stage in job["stages"]) == pytest.approx(1, abs=0.01)
    assert server.client.get(answer.headers["location"]).json() == job
    assert server.services.store.head(sha256(picture)).bytes == len(picture)


def test_the_spec_may_be_a_file_part_and_is_not_needed(server: ApiServer) -> None:
    given = server.client.post(
        "/v1/jobs", files={"image": png(), "spec": ("spec.json", json.dumps(SPEC), "application/json")}
    )
    assert given.json()["spec"]["preset"] == "draft"
    assert server.submit()["spec"]["preset"] == "paper"


@pytest.mark.parametrize(
    ("spec", "field"),
    [
        ({"optics": {"width_mm": 0}}, "spec.optics.width_mm"),
        ({"optik": {}}, "spec.optik"),
        ({"passes": [{"radius_mm": 3, "pitch_mm": 9}]}, "spec.passes.0.pitch_mm"),
        ({"preset": "nice"}, "spec.preset"),
        ({"preset": {"a": 1}}, "spec.preset"),
        ({"machine": {"profile": "../../etc/passwd"}}, "spec.machine.profile"),
    ],
)
def test_a_refused_spec_names_the_key(server: ApiServer, spec: dict, field: str) -> None:
    before = server.files()
    body = problem(server.client.post("/v1/jobs", files={"image": png()}, data={"spec": json.dumps(spec)}), 422, field)
    assert body["type"].endswith(":spec") and server.files() == before


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '"x"', '{"preset": "draft", "preset": "paper"}', '{"optics": {"width_mm": NaN}}', "[" * 50_000,
     '{"a":' * 30 + "1" + "}" * 30, '{"optics": {"width_mm": 1e999}}', '{"image": {"pixels": %s}}' % ("9" * 5000),
     '{"passes": {"a": 1}}', '{"passes": [1]}', '{"machine": []}', '{"optics": null}', '{"preset": null}',
     '{"machine": {"profile": []}}', '{"machine": {"profile": "\\u0000"}}', '{"\\ud800": 1}', '{"preset": "\\ud800"}'],
)  # fmt: skip
def test_odd_json_is_refused_in_words(server: ApiServer, text: str) -> None:
    problem(server.client.post("/v1/jobs", files={"image": png()}, data={"spec": text}), 422)


def test_a_picture_of_one_byte_too_many_is_refused(tmp_path: Path) -> None:
    """The form around it has room of its own, which is not the picture's."""
    with api_server(tmp_path / "data", max_upload_mb=0.001) as server:
        picture = png().ljust(1000, b"\0")
        server.submit(image=picture)
        before = server.files()
        problem(server.client.post("/v1/jobs", files={"image": picture + b"\0"}), 413, "image")
        assert server.files() == before


def test_the_same_key_and_request_give_the_same_job(server: ApiServer) -> None:
    picture, key = png(), {"Idempotency-Key": str(uuid.uuid4())}
    first = server.submit(image=("a.png", picture), data={"spec": json.dumps(SPEC)}, headers=key)
    with ThreadPoolExecutor(8) as pool:
        again = list(
            pool.map(
                lambda _: server.submit(image=("b.png", picture), data={"spec": json.dumps(SPEC)}, headers=key),
                range(8),
            )
        )
    assert {job["id"] for job in again} == {first["id"]}
    for other in ({"data": {"spec": "{}"}}, {"data": {"spec": json.dumps(SPEC), "priority": "low"}}):
        answer = server.client.post("/v1/jobs", files={"image": picture}, headers=key, **other)
        assert problem(answer, 422, "Idempotency-Key")["type"].endswith(":key-reused")
    answer = server.client.post("/v1/jobs", files={"image": png()}, data={"spec": json.dumps(SPEC)}, headers=key)
    problem(answer, 422, "Idempotency-Key")


@pytest.mark.parametrize("key", ["", "x" * 201, "a\x7f", "schlüssel"])
def test_a_key_is_printable_and_short(server: ApiServer, key: str) -> None:
    headers = {"Idempotency-Key": key.encode()}
    answer = server.client.post("/v1/jobs", files={"image": png()}, headers=headers)
    assert answer.status_code in (400, 422)


def test_the_list_is_walked_page_by_page(server: ApiServer) -> None:
    made = [server.submit()["id"] for _ in range(5)]
    for job_id in made[:2]:
        server.client.post(f"/v1/jobs/{job_id}:cancel").raise_for_status()
    seen, address = [], "/v1/jobs?limit=2"
    while address:
        page = server.client.get(address).json()
        assert len(page["jobs"]) <= 2 and "spec" not in page["jobs"][0]
        seen += [job["id"] for job in page["jobs"]]
        address = page["next"]
    assert seen[:5] == made[::-1] and len(seen) == len(set(seen))
    cancelled = server.client.get("/v1/jobs", params={"state": "cancelled", "limit": 200}).json()["jobs"]
    assert {job["state"] for job in cancelled} == {"cancelled"} and set(made[:2]) <= {job["id"] for job in cancelled}
    both = server.client.get("/v1/jobs?state=cancelled&state=queued&limit=200").json()["jobs"]
    assert set(made) <= {job["id"] for job in both}


@pytest.mark.parametrize(
    ("query", "field"),
    [("limit=0", "limit"), ("limit=201", "limit"), ("limit=x", "limit"), ("state=done", "state.0"),
     ("cursor=x", "cursor"), (f"cursor={UNKNOWN_ID}", "cursor")],
)  # fmt: skip
def test_a_wrong_query_names_the_parameter(server: ApiServer, query: str, field: str) -> None:
    problem(server.client.get(f"/v1/jobs?{query}"), 422, field)


def test_an_unchanged_job_is_not_sent_again(server: ApiServer) -> None:
    job = server.submit()
    address = f"/v1/jobs/{job['id']}"
    answer = server.client.get(address, headers={"If-None-Match": f'"x", W/{job["etag"]}'})
    assert answer.status_code == 304 and not answer.content and answer.headers["etag"] == job["etag"]
    server.client.post(f"{address}:cancel").raise_for_status()
    assert server.client.get(address, headers={"If-None-Match": job["etag"]}).status_code == 200


def test_cancel_retry_and_delete(server: ApiServer) -> None:
    client, address = server.client, f"/v1/jobs/{server.submit()['id']}"
    problem(client.post(f"{address}:retry"), 409)
    for _ in range(2):
        assert client.post(f"{address}:cancel").json()["state"] == "cancelled"
    again = client.post(f"{address}:retry")
    assert again.status_code == 202 and again.json()["state"] == "queued" and again.json()["attempt"] == 2
    assert client.delete(address).status_code == 204
    for answer in (client.get(address), client.delete(address), client.post(f"{address}:cancel")):
        problem(answer, 404, "id")
    for part in ("/events", "/artifacts", "/archive.zip", "/artifacts/report.json", "/programs/1"):
        problem(client.get(address + part), 404)


def test_what_runs_or_succeeded_cannot_be_changed_at_will(server: ApiServer) -> None:
    client, job_id = server.client, server.submit()["id"]
    server.put_state(job_id, "running")
    problem(client.delete(f"/v1/jobs/{job_id}"), 409)
    cancelling = client.post(f"/v1/jobs/{job_id}:cancel").json()
    assert cancelling["state"] == "running" and cancelling["cancel_requested"]
    server.put_state(job_id, "succeeded")
    for verb in ("cancel", "retry"):
        problem(client.post(f"/v1/jobs/{job_id}:{verb}"), 409)
    client.delete(f"/v1/jobs/{job_id}").raise_for_status()


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [("GET", "/v2", 404), ("GET", "/v1/jobs/", 404), ("GET", "/v1/jobs/1", 404), ("PUT", "/v1/jobs", 405),
     ("GET", f"/v1/jobs/{UNKNOWN_ID}:cancel", 405), ("POST", f"/v1/jobs/{UNKNOWN_ID}:explode", 404),
     ("GET", "/v1/jobs/%2e%2e/%2e%2e/etc/passwd", 404), ("GET", f"/v1/jobs/{UNKNOWN_ID}", 404),
     ("GET", f"/v1/jobs/{UNKNOWN_ID}/artifacts/..%2f..%2fsecret", 404), ("GET", "/docs", 404)],
)  # fmt: skip
def test_what_is_not_there_is_a_problem_too(server: ApiServer, method: str, path: str, status: int) -> None:
    problem(server.client.request(method, path), status)


@pytest.mark.parametrize(
    "spec",
    ['{"optics":{"width_mm":1e-320,"height_mm":2000}}', '{"optics":{"width_mm":1e999}}',
     '{"optics":{"screen_width_mm":1e-320}}', '{"machine":{"profile":"\\ud800"}}', '{"optics":{"width_mm":1e-320}}',
     '{"image":{"pixels":' + "9" * 400 + "}}", '{"image":{"pixels":' + "9" * 5000 + "}}"],
    ids=str,
)  # fmt: skip
def test_numbers_that_no_lens_has_are_refused_or_taken_but_are_no_fault(server: ApiServer, spec: str) -> None:
    answer = server.client.post("/v1/jobs", files={"image": png()}, data={"spec": spec})
    assert answer.status_code in (202, 422), answer.text


def test_a_job_s_picture_is_of_what_the_wall_will_show_and_small(server: ApiServer) -> None:
    """So that a list need not ask for the files of each job."""
    job = server.submit()["id"]
    address = f"/v1/jobs/{job}"
    assert "picture" not in server.client.get(address).json()["links"]
    thumbnails = [f"thumbnail{of}.png" for of in ("", "-as-milled", "-as-finished")]
    for content, name in enumerate(("caustic.png", "target.png", *thumbnails)):
        server.put_artifact(job, name, b"1" * (9 + content), stage="irradiance")
        listed = next(one for one in server.client.get("/v1/jobs").json()["jobs"] if one["id"] == job)
        looked = server.client.get(address).json()
        wanted = None if name == "caustic.png" else f"{address}/artifacts/{name}"
        assert listed["links"].get("picture") == looked["links"].get("picture") == wanted


def test_a_list_shows_lens_mill_and_hours_of_each_job(server: ApiServer) -> None:
    """Hours are those of all programs, as soon as every time is known."""
    spec = {"optics": {"width_mm": 40.0, "height_mm": 30.0}, "machine": {"profile": "grbl-3018"}}
    made = server.submit(data={"spec": json.dumps(spec)})["id"]
    listed = next(one for one in server.client.get("/v1/jobs").json()["jobs"] if one["id"] == made)
    looked = server.client.get(f"/v1/jobs/{made}").json()
    for found in (listed, looked):
        assert (found["lens_mm"], found["machine"], found["hours"]) == ([40.0, 30.0], "grbl-3018", None)


@pytest.mark.parametrize(
    ("report", "hours"),
    [
        (None, None),
        ({"passes": [{"time_s": 1800.0}]}, 0.5),
        ({"passes": [{"time_s": 1800.0}, {"time_s": 900.0}], "around": {"cut-out": {"time_s": 900.0}}}, 1.0),
        ({"passes": [{"time_s": 1800.0}, {"time_s": None}]}, None),
    ],
)
def test_hours_of_a_job_are_those_of_all_its_programs(report: dict[str, object] | None, hours: float | None) -> None:
    assert make_view(job(report), position=None, progress=None, picture=None, runs=(), files=()).hours == hours


BALL = {"radius_mm": 3.0, "pitch_mm": 0.2}


def job(report: dict[str, object] | None) -> Job:
    spec = resolve_spec(preset="recommended").plain()
    return Job(
        id="a" * 26, name="a", state=JobState.RUNNING, priority=0, spec=spec, figures=None, image_sha256="b" * 64,
        image_bytes=1, created_by="c", created_at=0.0, queued_at=0.0, started_at=0.0, ended_at=None, stage=None,
        progress=0.0, error=None, report=report, cancel_requested=False, attempt=1, owner=None, fence=1, version=1,
    )  # fmt: skip


def passes_shown(report: dict[str, object] | None) -> list[str]:
    shown = make_view(job(report), position=None, progress=None, picture=None, runs=(), files=()).stages
    assert abs(sum(stage.share for stage in shown) - 1.0) < 1e-3
    return [stage.name for stage in shown if stage.name.startswith("pass-")]


def test_once_passes_are_planned_their_stages_are_shown() -> None:
    """Until then those of usual ones."""
    rows = [{"name": "rough", "stock_to_leave_mm": 0.2, **BALL}, {"name": "rough", "stock_to_leave_mm": 0.1, **BALL}]
    plan = {"passes": [*rows, BALL], "min_radius_mm": 3.0, "foreseen_blur_mm": [0.0, 0.3], "whole_steps": True}
    assert passes_shown(None) == ["pass-1", "pass-2"]
    assert passes_shown({"plan": plan}) == ["pass-1", "pass-2", "pass-3"]
