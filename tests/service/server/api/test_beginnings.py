"""What a new job can begin with: profiles of machines, and another job's picture and spec."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from machines.profile import load_profile, profile_names
from service.server.api.routes.profiles import mills_by_profile
from service.server.fleet.registry import KnownMachine
from tests.service.server.api.server import ApiServer, png, problem, sha256


def test_a_job_made_from_another_job_s_request_is_the_same_job(server: ApiServer) -> None:
    picture = png()
    spec = {"preset": "draft", "optics": {"width_mm": 31.0}, "image": {"invert": True}}
    job = server.submit(image=("Über: mich.png", picture), data={"spec": json.dumps(spec)})
    asked = server.client.get(f"/v1/jobs/{job['id']}/request").json()
    assert asked["spec"] == spec and asked["name"] == job["name"]
    image = server.client.get(asked["image"])
    assert image.content == picture and image.headers["etag"] == f'"{sha256(picture)}"'
    again = server.submit(image=(asked["name"], image.content), data={"spec": json.dumps(asked["spec"])})
    assert again["id"] != job["id"]
    assert (again["spec"], again["image"], again["name"]) == (job["spec"], job["image"], job["name"])


def test_a_stranger_s_picture_is_no_page_of_ours(server: ApiServer) -> None:
    """Whatever is in the bytes, a browser that is led there saves them."""
    job = server.submit()
    got = server.client.get(f"/v1/jobs/{job['id']}/image", headers={"Range": "bytes=0-3"})
    assert got.status_code == 206 and got.content == png()[:4]
    assert got.headers["content-type"] == "application/octet-stream"
    assert got.headers["x-content-type-options"] == "nosniff"
    assert got.headers["content-disposition"].startswith("attachment")


def test_no_such_job_no_request(server: ApiServer) -> None:
    nobody = "/v1/jobs/00000000-0000-4000-8000-000000000000"
    for address in (f"{nobody}/request", f"{nobody}/image"):
        assert problem(server.client.get(address), 404)["field"] == "id"


def test_the_profiles_are_those_a_spec_may_name(server: ApiServer) -> None:
    profiles = server.client.get("/v1/profiles").json()["profiles"]
    assert [profile["name"] for profile in profiles] == sorted(profile_names())
    assert all(profile["description"] and len(profile["travel_mm"]) == 3 for profile in profiles)


@pytest.mark.parametrize(
    ("mill", "changes", "profile"),
    [
        ("simulated", {"homing": True, "description": "a model"}, "grbl"),
        ("grbl-3018", {}, "grbl-3018"),
        ("elsewhere", {"travel_mm": (250.0, 300.0, 80.0)}, None),
    ],
)
def test_a_mill_stands_beside_the_profile_that_its_programs_are_made_with(
    mill: str, changes: dict[str, Any], profile: str | None
) -> None:
    """By name, or where nothing differs that a program depends on; nowhere else."""
    known = KnownMachine(name=mill, profile=replace(load_profile("grbl"), name=mill, **changes))
    found = mills_by_profile([known], [load_profile(name) for name in ("grbl", "grbl-3018", "linuxcnc")])
    assert found == ({} if profile is None else {profile: [known]})
