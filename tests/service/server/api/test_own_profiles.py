"""What the shop states of its own: mills of its own, and the end mills that it has."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from machines.profile import find_profiles, load_profile
from service.errors import InputError
from service.job.spec.loading import restore_job
from service.job.spec.own_files import PROFILE_KEYS, forget_profile, read_stated_profiles, save_profile
from service.job.spec.tools import load_tools
from service.server.schemas.jobs import ProfileBody
from tests.service.server.api.server import ApiServer, api_server, png, problem

MINE = {"extends": "grbl", "description": "Fräse im Keller \N{SNOWFLAKE}", "step_mm": 0.0025, "collet_mm": 8.0}


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "shop"))
    with api_server(tmp_path / "data") as found:
        yield found


def operator(server: ApiServer) -> dict[str, str]:
    return {
        "Authorization": f"Bearer {server.services.tokens.create('op', ['machine:run', 'jobs:write', 'jobs:read'])[1]}"
    }


def test_a_job_is_made_for_a_mill_that_was_stated_and_keeps_its_figures(server: ApiServer) -> None:
    token = operator(server)
    problem(server.client.put("/v1/profiles/keller", json=MINE), 401)
    told = server.client.put("/v1/profiles/keller", json=MINE, headers=token).json()["profiles"]
    (mine,) = [one for one in told if one["name"] == "keller"]
    usual = load_profile("grbl")
    assert (mine["step_mm"], mine["collet_mm"], mine["z_noise_mm"]) == (0.0025, 8.0, usual.z_noise_mm)
    assert {key: value for key, value in mine["stated"].items() if value is not None} == MINE
    spec = {"spec": (None, b'{"preset": "draft", "machine": {"profile": "keller"}}')}
    answer = server.client.post("/v1/jobs", files={"image": ("p.png", png())} | spec, headers=token)
    assert answer.status_code == 202, answer.text
    job = answer.json()["id"]
    server.client.delete("/v1/profiles/keller", headers=token)
    assert server.client.get("/v1/profiles", headers=token).json()["profiles"] == [
        one for one in told if one is not mine
    ]
    kept = server.services.book.get(job)
    assert restore_job(kept.spec, kept.figures).machine.step_mm == 0.0025


@pytest.mark.parametrize("name", ["../up", ".hidden", "a/b", "a\\b", " ", "x" * 41, "a%0Ab"])
def test_a_name_that_is_no_file_s_is_refused(server: ApiServer, name: str) -> None:
    token = operator(server)
    answer = server.client.put(f"/v1/profiles/{name.replace('/', '%2F')}", json=MINE, headers=token)
    assert answer.status_code in (404, 405, 422) and not list(
        Path(server.services.settings.data).parent.rglob("*.toml")
    )


@pytest.fixture
def shop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    (tmp_path / "machines").mkdir()
    return tmp_path / "machines"


@pytest.mark.parametrize(
    "text",
    [
        'extends = "grbl"\n\n[link]\nport = "/dev/ttyUSB0"\n',
        '# mine\nextends = "grbl"\n',
        'extends = "grbl"\nhoming = true\n',
    ],
)
def test_a_profile_written_by_hand_is_neither_changed_nor_deleted(shop: Path, text: str) -> None:
    (shop / "hand.toml").write_text(text)
    for change in (lambda: save_profile("hand", MINE), lambda: forget_profile("hand")):
        with pytest.raises(InputError, match="written by hand"):
            change()
    assert (shop / "hand.toml").read_text() == text and read_stated_profiles() == {}


@pytest.mark.parametrize(
    ("name", "values", "field", "words"),
    [
        ("grbl", MINE, "profile", "built-in"),
        ("mine", MINE | {"extends": "other"}, "extends", "extends = 'other': allowed: grbl"),
        ("mine", MINE | {"step_mm": 2.0}, "step_mm", "step_mm = 2.0: allowed"),
        ("mine", MINE | {"travel_mm": [300.0, 300.0, 4.0]}, "travel_mm.2", "safe_z_mm = 5"),
        ("mine", MINE | {"spindle_rpm": [9.0, 8.0]}, "spindle_rpm", "slowest, fastest"),
    ],
)
def test_what_cannot_be_is_refused_and_nothing_is_written(
    shop: Path, name: str, values: dict[str, object], field: str, words: str
) -> None:
    with pytest.raises(InputError, match=words) as refused:
        save_profile(name, values)
    assert refused.value.field == field
    assert not list(shop.iterdir())


@given(
    st.text(st.characters(blacklist_categories=("C", "Z")), max_size=20),
    st.floats(1e-6, 0.1),
    st.lists(st.floats(6, 1e4), min_size=3, max_size=3),
)
def test_what_is_stated_is_what_is_read(words: str, step_mm: float, travel_mm: list[float]) -> None:
    values = {"extends": "okuma-osp", "description": words, "travel_mm": [*travel_mm[:2], 400.0], "step_mm": step_mm}
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        patch.setenv("CAUSTICMILL_CONFIG_DIR", folder)
        made = save_profile("mine", values)
        assert read_stated_profiles() == {"mine": values} and load_profile("mine") == made
        assert (made.description, made.step_mm, list(made.travel_mm)) == (words, step_mm, values["travel_mm"])
        forget_profile("mine")
        assert set(find_profiles()) == set(find_profiles(()))


def test_the_body_has_the_keys_of_the_file() -> None:
    assert tuple(ProfileBody.model_fields) == PROFILE_KEYS


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
    for rows, field, words in (
        ([first | {"flute_length_mm": 0.1}], "tools.0.flute_length_mm", "tool 1: flute_length_mm = 0.1"),
        ([first, first], "tools", "no other tool has"),
    ):
        assert words in problem(server.client.put("/v1/tools", json={"tools": rows}), 422, field)["detail"]
    problem(server.client.put("/v1/tools", json={"tools": []}), 422, "tools")
    assert server.client.get("/v1/tools").json() == usual
