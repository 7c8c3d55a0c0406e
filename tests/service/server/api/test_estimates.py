"""POST /v1/estimates over the wire: the same form and the same refusals as POST /v1/jobs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.job.stages.order import StageOrder
from service.processes.kernel_cache import ESTIMATES, ready_mark
from service.server.api.intake.child_requests import Estimator
from service.server.worker import stage_entry
from tests.service.server.api.server import ApiServer, api_server, callers_of, png, problem
from tests.service.server.api.test_estimating import STUB
from tests.waiting import PATIENCE_S, until

SMALL = {"preset": "draft", "image": {"pixels": 64}, "optics": {"width_mm": 20, "height_mm": 20, "throw_mm": 40}}


@pytest.fixture(scope="module")
def estimating(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ApiServer]:
    with api_server(tmp_path_factory.mktemp("estimates") / "data", max_upload_mb=2, max_megapixels=4) as running:
        yield running


def sent(server: ApiServer, path: str, *, spec: Any = None, image: Any = None) -> httpx.Response:
    data = {} if spec is None else {"spec": spec if isinstance(spec, str) else json.dumps(spec)}
    files = {"image": image or ("picture.png", png())}
    return server.client.post(path, files=files, data=data, timeout=PATIENCE_S)


@pytest.mark.thorough
def test_an_estimate_tells_all_and_leaves_nothing(estimating: ApiServer) -> None:
    before = estimating.files()
    answer = sent(estimating, "/v1/estimates", spec=SMALL)
    assert answer.status_code == 200, answer.text
    found = answer.json()
    assert found["hours"] == pytest.approx(sum(row["hours"] for row in found["passes"]))
    assert [row["name"] for row in found["passes"]] == ["rough", "finish"]
    assert found["relief_mm"] >= 0
    assert (found["thickness_ok"], found["throw_ok"], found["planned"]) == (True, True, False)
    assert estimating.files() == before
    job = estimating.submit(data={"spec": json.dumps(SMALL)})
    assert found["spec"] == job["spec"] or set(job["spec"]) <= set(found["spec"])


@pytest.mark.parametrize(
    "spec",
    [
        {"optics": {"width_mm": -3, "throw_mm": "far"}},
        {"optcs": {}},
        {"preset": "best"},
        {"machine": {"profile": "none such"}},
        {"passes": []},
        "{",
        "[]",
        '{"preset": "draft", "preset": "paper"}',
    ],
)
def test_a_bad_spec_is_refused_as_a_job_is(estimating: ApiServer, spec: Any) -> None:
    ours, theirs = (sent(estimating, path, spec=spec) for path in ("/v1/estimates", "/v1/jobs"))
    assert ours.status_code == theirs.status_code == 422
    assert problem(ours, 422) == theirs.json()


@pytest.mark.parametrize("image", [("a.png", b"no picture"), ("a.png", b""), ("big.png", b"x" * 3_000_000)])
def test_a_bad_picture_is_refused_as_a_job_is(estimating: ApiServer, image: tuple[str, bytes]) -> None:
    ours, theirs = (sent(estimating, path, spec=SMALL, image=image) for path in ("/v1/estimates", "/v1/jobs"))
    assert 400 <= ours.status_code < 500
    assert problem(ours, theirs.status_code) == theirs.json()


def test_a_caller_s_windows_do_not_end_each_other_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one window the newest question wins, as ever."""
    monkeypatch.setattr("service.server.api.main.Estimator", partial(Estimator, module=STUB))
    with api_server(tmp_path / "data") as server, ThreadPoolExecutor(3) as threads:

        def asked(tab: str) -> Future[httpx.Response]:
            files = {"image": ("takes 0.5.png", png())}
            return threads.submit(server.client.post, "/v1/estimates", files=files, headers={"Causticmill-Tab": tab})

        one, other = asked("one"), asked("other")
        until(lambda: server.services.estimates.child_pid is not None)
        until(lambda: len(callers_of(server.services.estimates)) == 2)
        newer = asked("one")
        assert [answer.result().status_code for answer in (one, other, newer)] == [409, 200, 200]


def test_an_exact_estimate_ends_when_its_window_asks_for_another_or_goes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.server.api.main.Estimator", partial(Estimator, module=STUB))
    with api_server(tmp_path / "data") as server, ThreadPoolExecutor(1) as threads:
        exactly = server.services.exact_estimates

        def ask(name: str, *, wait_s: float = PATIENCE_S, **query: bool) -> httpx.Response:
            files, headers = {"image": (name, png())}, {"Causticmill-Tab": "one"}
            return server.client.post("/v1/estimates", files=files, params=query, headers=headers, timeout=wait_s)

        waiting = threads.submit(ask, "takes 600.png", exactly=True)
        until(lambda: callers_of(exactly))
        assert ask("quick.png").json()["warnings"] == ["quick"]
        assert waiting.result().status_code == 409
        with pytest.raises(httpx.ReadTimeout):
            ask("takes 601.png", wait_s=1.0, exactly=True)
        until(lambda: not callers_of(exactly))


def test_what_the_first_estimate_needs_can_be_compiled_before_it(estimating: ApiServer) -> None:
    ready_mark(ESTIMATES).unlink(missing_ok=True)
    estimating.services.estimates.prepare()
    until(ready_mark(ESTIMATES).exists)


def test_estimates_and_stages_keep_their_plans_in_the_same_folder(
    estimating: ApiServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders: list[Path] = []

    def ask(_: Estimator, caller: str, asked: dict[str, Any], *, is_long: bool = False) -> Future[dict[str, Any]]:
        folders.append(Path(asked["plans"]))
        raise Problem(503, Phrase("enough"))

    def run(order: StageOrder, store: object, on_progress: object, *, plans: Path) -> StageOrder:
        folders.append(plans)
        return order

    monkeypatch.setattr(Estimator, "ask", ask)
    assert sent(estimating, "/v1/estimates", spec=SMALL).status_code == 503
    monkeypatch.setattr(stage_entry, "run_order", run)
    monkeypatch.setattr(StageOrder, "from_plain", lambda plain: SimpleNamespace(plain=dict))
    monkeypatch.setenv("CAUSTICMILL_DATA", str(estimating.services.settings.data))
    stage_entry.run_stage({}, print)
    assert folders == [estimating.services.settings.data / "plans"] * 2


def test_what_only_the_lens_tells_is_told(estimating: ApiServer, tmp_path: Path) -> None:
    """A block too thin for the lens: a job would fail later."""
    short = SMALL | {"stock": {"thickness_mm": 2.1}}
    found = sent(estimating, "/v1/estimates", spec=short).json()
    assert found["thickness_ok"] is (found["relief_mm"] < 0.01)
    assert {row["detail"] for row in found["refusals"]} <= found["phrases"].keys()


@pytest.mark.parametrize("address", ["/v1/estimates", "/v1/jobs"])
def test_a_job_wider_than_the_mill_travels_is_refused_at_once(estimating: ApiServer, address: str) -> None:
    """By the field, with the width that would do."""
    answer = sent(estimating, address, spec=SMALL | {"machine": {"travel_mm": [10, 300, 80]}})
    assert answer.status_code == 422
    (row,) = answer.json()["problems"]
    assert (row["field"], row["use"]) == ("spec.optics.width_mm", 4)
    assert "machine.travel_mm.0" in row["detail"] and "at most 4 mm on this mill" in row["detail"]


def test_a_wall_too_near_is_refused_beside_its_field_with_one_that_does(estimating: ApiServer) -> None:
    near = SMALL | {"optics": SMALL["optics"] | {"throw_mm": 1}}
    (row,) = problem(sent(estimating, "/v1/estimates", spec=near), 422, "spec.optics.throw_mm")["problems"]
    assert row["field"] == "spec.optics.throw_mm"
    assert row["use"] > 1 and f"{row['use']:.0f} mm" in row["detail"]
