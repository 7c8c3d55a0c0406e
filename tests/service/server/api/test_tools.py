"""The shop's own ball end mills, stated over REST: new jobs are planned with them, those that are there are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.job.spec.loading import restore_job
from service.job.spec.tools import load_tools
from tests.service.server.api.server import ApiServer, api_server, png, problem


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "shop"))
    with api_server(tmp_path / "data") as found:
        yield found


def planned_with(server: ApiServer) -> list[str]:
    """Names of the tools that a job posted now is planned with."""
    spec = {"spec": (None, b'{"preset": "recommended"}')}
    job = server.client.post("/v1/jobs", files={"image": ("p.png", png())} | spec).json()["id"]
    kept = server.services.book.get(job)
    return [tool.name for tool in restore_job(kept.spec, kept.figures).figures.tools]


def test_new_jobs_are_planned_with_what_the_shop_has(server: ApiServer) -> None:
    usual = server.client.get("/v1/tools").json()
    assert usual["own"] is False and [tool["name"] for tool in usual["tools"]] == [one.name for one in load_tools()]
    mine = [tool for tool in usual["tools"] if tool["radius_mm"] in (1.0, 2.0)]
    before = planned_with(server)
    told = server.client.put("/v1/tools", json={"tools": mine}).json()
    assert told == {"tools": mine, "own": True}
    assert planned_with(server) == [tool["name"] for tool in mine] != before
    assert server.client.delete("/v1/tools").json() == usual
    assert planned_with(server) == before


def test_a_tool_that_cannot_be_is_refused_by_name_and_the_list_stays(server: ApiServer) -> None:
    usual = server.client.get("/v1/tools").json()
    first = usual["tools"][0]
    for rows, words in (
        ([first | {"flute_length_mm": 0.1}], "tool 1: flute_length_mm = 0.1"),
        ([first, first], "no other tool has"),
    ):
        assert words in problem(server.client.put("/v1/tools", json={"tools": rows}), 422)["detail"]
    problem(server.client.put("/v1/tools", json={"tools": []}), 422, "tools")
    assert server.client.get("/v1/tools").json() == usual
