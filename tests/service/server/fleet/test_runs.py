"""From checked programs to a finished part: everything real but the mill, which is simulated to firmware traps."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.server.fleet.agent_launcher import start_agents
from service.server.fleet.fleet import Fleet
from tests.service.mills import Bench, ends
from tests.service.server.api.server import api_server
from tests.service.server.fleet.shop import (
    CHECKS,
    LINES,
    MACHINE,
    Shop,
    await_agent,
    give,
    kill_agents,
    shop,
    write_profile,
)
from tests.waiting import until


def test_a_program_is_parked_started_held_resumed_and_finished(floor: Shop) -> None:
    job = floor.job((500,))
    run = floor.park(job, program=1)
    assert (run["state"], run["open"], run["required_checks"]) == ("parked", True, CHECKS)
    assert (run["program"]["name"], floor.bench.cut) == ("pass-1-finish.nc", [])
    refused = floor.start(run, 409, checks=["tool", "zero", "clear"])
    assert "stock" in refused["detail"] and floor.bench.cut == []
    assert floor.start(run)["operator"] == "Ada"
    floor.until_cut(8)
    floor.post(f"/v1/runs/{run['id']}:hold", 202)
    held = floor.until_state(run, "held")
    assert floor.bench.stands and held["share"] < 1
    assert floor.get(f"/v1/machines/{MACHINE}")["mill"]["state"] == "held"
    floor.post(f"/v1/runs/{run['id']}:resume", 202)
    done = floor.until_finished(run)
    assert (done["share"], done["open"], done["next"], done["required_checks"]) == (1.0, False, None, [])
    assert floor.bench.cut == ends(500)


def test_a_mill_has_one_run_and_is_free_again_when_it_is_over(floor: Shop) -> None:
    job = floor.job()
    first = floor.park(job)
    assert first["id"] in floor.park(job, 409)["detail"]
    assert floor.get(f"/v1/machines/{MACHINE}")["run"]["id"] == first["id"]
    gone = floor.post(f"/v1/runs/{first['id']}:abort", 202)
    assert (gone["state"], gone["open"]) == ("aborted", False)
    assert floor.park(job)["state"] == "parked"
    assert floor.bench.cut == []


def test_each_sentence_without_a_code_can_be_said_in_another_language(floor: Shop) -> None:
    """On its way from preflight, journal and agent over the database it keeps its template and values."""
    job = floor.job((600,))
    floor.server.put_artifact(job, "pass-2-odd.nc", b"G21 G90\nG0 X1 Y1 Z1\nM3 S99999\nG1 X2 F100\n")
    floor.server.put_artifact(job, "pass-3-bad.nc", b"G21 G90\nG1 X1 F100\nT1 M6\nM2\n")
    answers = [floor.park(job, 422, program=3), floor.park(job, 422, program=9), odd := floor.park(job, program=2)]
    assert len(odd["warnings"]) == 4
    answers += [floor.park(job, 409), floor.post(f"/v1/runs/{odd['id']}:abort", 202)]
    run = floor.park(job, program=1)
    answers.append(floor.start(run, 409, checks=["tool"]))
    floor.start(run)
    floor.until_cut(8)
    floor.post(f"/v1/runs/{run['id']}:abort", 202)
    floor.until_state(run, "aborted")
    floor.until_idle()
    answers += [floor.get(f"/v1/runs/{run['id']}/recovery"), floor.get("/v1/runs"), floor.get("/v1/machines")]
    answers.append(floor.get(f"/v1/machines/{MACHINE}/orders"))
    assert [list(list_untold(answer)) for answer in answers] == [[]] * len(answers)
    told = json.dumps(answers)
    assert all(words in told for words in ("no end (M2", "line 3: 'T1", "are cut for certain", "in a hold"))


SENTENCES = {"detail", "words", "warnings", "refusals", "differences", "needs", "problem", "problems", "zero", "effect"}


def list_untold(answer: Any, known: frozenset[str] = frozenset()) -> Iterator[str]:
    """Yield the sentences of an answer that its phrases do not tell."""
    if isinstance(answer, dict):
        known |= answer.get("phrases", {}).keys()
        for name, value in answer.items():
            texts = value if isinstance(value, list) else [value]
            if name in SENTENCES and not answer.get("code"):
                yield from (one for one in texts if isinstance(one, str) and one and one not in known)
            if name != "phrases":
                yield from list_untold(value, known)
    elif isinstance(answer, list):
        for one in answer:
            yield from list_untold(one, known)


def test_a_dry_pass_runs_in_the_air_and_never_counts_as_cut(floor: Shop) -> None:
    job = floor.job((30, 40))
    dry = floor.park(job, lift_mm=20)
    assert (dry["lift_mm"], dry["required_checks"], dry["program"]["number"]) == (20.0, CHECKS, 1)
    assert not any("spindle off" in one for one in dry["warnings"])
    assert floor.get(f"/v1/machines/{MACHINE}")["run"]["lift_mm"] == 20.0
    floor.start(dry)
    done = floor.until_finished(dry)
    assert floor.bench.cut == [(x, y, z + 20.0) for x, y, z in ends(30)]
    assert not any(one.spindle_on for one in floor.bench.mill.recording.cuts())
    assert (done["next"]["number"], done["share"], done["left_out"]) == (1, 1.0, [])
    assert not floor.get(f"/v1/machines/{MACHINE}")["mill"]["needs"]  # no tool has cut: there is nothing to touch off
    second = floor.park(job, program=2, lift_mm=20)
    assert (second["required_checks"], second["left_out"][0]["number"]) == (CHECKS, 1)
    floor.post(f"/v1/runs/{second['id']}:abort", 202)
    real = floor.park(job)
    assert (real["program"]["number"], real["lift_mm"]) == (1, None)
    floor.post(f"/v1/runs/{real['id']}:abort", 202)
    assert floor.park(job, 201, program=2)["required_checks"] == [*CHECKS, "order"]


@pytest.mark.parametrize("lift_mm", [0, 0.5, 201, -5, "20", True])
def test_a_dry_pass_is_high_enough_and_not_beyond_any_mill(floor: Shop, lift_mm: object) -> None:
    assert floor.park(floor.job((30,)), 422, lift_mm=lift_mm)["field"] == "lift_mm"


def test_a_program_that_cannot_be_raised_has_no_dry_pass(floor: Shop) -> None:
    job = floor.job((30,))
    floor.server.put_artifact(job, "pass-2-odd.nc", b"G21 G90 G17 G94 G54\nM3 S1000\nG91 G1 X2 F100\nM5\nM2\n")
    refused = floor.park(job, 422, program=2, lift_mm=20)
    assert "line 3" in refused["detail"] and "dry pass" in refused["detail"]


def test_a_key_is_for_a_dry_pass_or_for_the_program_itself(floor: Shop) -> None:
    job, key = floor.job((30,)), {"Idempotency-Key": "k"}
    path = f"/v1/machines/{MACHINE}/runs"
    first = floor.operator.post(path, json={"job": job, "lift_mm": 20}, headers=key).json()
    again = floor.operator.post(path, json={"job": job, "lift_mm": 20}, headers=key).json()
    assert first["id"] == again["id"]
    assert floor.operator.post(path, json={"job": job}, headers=key).status_code == 422


@pytest.mark.thorough
def test_passes_follow_each_other_and_the_tool_change_is_told(floor: Shop) -> None:
    job = floor.job()
    for number in (1, 2, 3):
        run = floor.park(job)
        change = run["setup"]["change"]
        assert run["program"]["number"] == number
        assert run["required_checks"] == CHECKS and run["left_out"] == []
        assert (change is None) == (number == 1)
        if number == 2:
            assert "from R 3 (Ø 6 mm) to R 0.5 (Ø 1 mm)" in change["words"] and "Z zero again" in change["words"]
        assert (run["next"] or {}).get("number") == {1: 2, 2: 3, 3: None}[number]
        floor.start(run)
        floor.until_finished(run)
    assert floor.bench.cut == [end for count in LINES for end in ends(count)]
    assert "every program" in floor.park(job, 409)["detail"]
    assert floor.park(job, program="pass-1-rough.nc")["program"]["number"] == 1


@pytest.mark.thorough
def test_a_pass_out_of_order_needs_a_word_about_it(floor: Shop) -> None:
    run = floor.park(floor.job(), program=2)
    assert run["required_checks"] == [*CHECKS, "order"]
    assert [one["number"] for one in run["left_out"]] == [1]
    refused = floor.start(run, 409, checks=CHECKS)
    assert (refused["field"], "pass-1-rough.nc" in refused["detail"], floor.bench.cut) == ("checks", True, [])
    floor.start(run, checks=[*CHECKS, "order"])
    floor.until_finished(run)


@pytest.mark.thorough
def test_programs_may_be_run_as_soon_as_all_are_checked(floor: Shop) -> None:
    """The job goes on with pictures of what they will make; it is not begun again under the run."""
    job = floor.job(state="running")
    floor.server.put_state(job, "running", cancel_requested=True)
    assert "being cancelled" in floor.park(job, 409)["detail"]
    floor.server.put_state(job, "running", cancel_requested=False)
    floor.server.put_stage(job, "pass-3")  # once more, and not checked since
    assert floor.park(job, 409)["field"] == "job"
    floor.server.put_stage(job, "check")
    run = floor.park(job)
    floor.server.put_state(job, "failed")
    with floor.client("jobs:write") as writer:
        again = writer.post(f"/v1/jobs/{job}:retry")
        assert (again.status_code, run["id"] in again.json()["detail"]) == (409, True)
        floor.start(run)
        floor.until_finished(run)
        assert writer.post(f"/v1/jobs/{job}:retry").status_code == 202


@pytest.mark.thorough
def test_what_cannot_be_handed_over_is_told_and_leaves_the_mill_free(floor: Shop) -> None:
    job = floor.job()
    assert floor.park(job, 422, program=9)["field"] == "program"
    assert floor.park("nowhere", 422)["field"] == "job"
    assert floor.post("/v1/machines/none/runs", 404, job=job)["field"] == "machine"
    floor.server.put_artifact(job, "pass-4-bad.nc", b"G21 G90\nG1 X1 F100\nT1 M6\nM2\n")
    bad = floor.park(job, 422, program=4)
    assert (bad["field"], "line 3" in bad["detail"]) == ("program", True)
    (refused,) = floor.get("/v1/runs")["runs"]
    assert (refused["state"], refused["open"]) == ("refused", False)
    assert floor.park(job)["state"] == "parked"


def test_a_program_whose_content_is_not_what_its_hash_says_never_reaches_the_mill(floor: Shop) -> None:
    job = floor.job()
    sha256 = next(a.sha256 for a in floor.server.services.book.list_artifacts(job) if a.name == "pass-1-rough.nc")
    path = floor.server.services.store.path(sha256)
    assert path is not None
    content = path.read_bytes()
    path.chmod(0o600)
    path.write_bytes(content.replace(b"X1.000", b"X9.000"))
    assert floor.park(job, 422)["field"] == "sha256"
    assert floor.get("/v1/runs?machine=shop")["runs"][0]["state"] == "refused"


@pytest.mark.thorough
def test_an_agent_that_was_killed_leaves_a_run_that_a_person_recovers(floor_of_processes: Shop) -> None:
    floor = floor_of_processes
    run = floor.park(floor.job((600,)))
    floor.start(run)
    floor.until_cut(30)
    kill_agents(floor.data)
    away = floor.get(f"/v1/runs/{run['id']}")
    assert (away["unreachable"], away["state"]) == (True, "running")
    assert floor.get(f"/v1/machines/{MACHINE}")["agent"]["reachable"] is False
    assert floor.operator.post(f"/v1/runs/{run['id']}:hold").status_code == 503
    start_agents(floor.settings)
    await_agent(floor.folder)
    found = floor.until_state(run, "interrupted")
    assert found["open"] and "position" in found["required_checks"]
    floor.until_idle()
    plan = floor.get(f"/v1/runs/{run['id']}/recovery")
    assert plan["run"] == run["id"] and plan["blocks"] is not None
    cut = len(floor.bench.cut)
    assert floor.get(f"/v1/runs/{run['id']}")["state"] == "interrupted"
    assert len(floor.bench.cut) == cut  # nothing goes on by itself
    floor.until(run, lambda now: floor.get(f"/v1/runs/{run['id']}/recovery")["ready"])
    floor.recover(run, found["required_checks"])
    floor.until_finished(run)
    assert set(ends(600)) <= set(floor.bench.cut)


@pytest.mark.thorough
def test_an_aborted_run_frees_the_mill_and_can_still_be_recovered(floor: Shop) -> None:
    job = floor.job((600,))
    run = floor.park(job)
    floor.start(run)
    floor.until_cut(8)
    floor.post(f"/v1/runs/{run['id']}:abort", 202)
    gone = floor.until_state(run, "aborted")
    assert gone["open"] is False and "position" in gone["required_checks"]
    other = floor.park(job)
    said = {"operator": "Ada", "checks": gone["required_checks"]}
    assert "plan" in floor.post(f"/v1/runs/{run['id']}:recover", 409, **said)["field"]
    said["plan"] = floor.get(f"/v1/runs/{run['id']}/recovery")["plan"]
    assert other["id"] in floor.post(f"/v1/runs/{run['id']}:recover", 409, **said)["detail"]
    floor.post(f"/v1/runs/{other['id']}:abort", 202)
    floor.until_idle()
    floor.recover(run, gone["required_checks"])
    assert floor.get(f"/v1/runs/{run['id']}")["open"] is True
    floor.until_finished(run)


def test_an_agent_that_is_down_takes_nothing_and_the_mill_is_not_taken(floor: Shop) -> None:
    kill_agents(floor.data)
    refused = floor.park(floor.job(), 503)
    assert refused["field"] == "machine"
    assert floor.get("/v1/runs")["runs"][0]["open"] is False


@pytest.mark.thorough
def test_an_agent_that_does_not_take_our_token_is_told_as_such(floor: Shop) -> None:
    token = floor.folder / "token"
    token.write_text("x" * 40 + "\n")
    job = floor.job()
    write_profile(floor.bench.url, text=f'extends = "grbl"\n[link]\nport = "{floor.bench.url}"\n')  # a new link
    assert "token" in floor.park(job, 503)["detail"]
    agent = floor.get(f"/v1/machines/{MACHINE}")["agent"]
    assert "token" in agent["words"] and agent["code"] == "agent_key_refused"


@pytest.mark.thorough
def test_a_job_with_an_open_run_is_not_deleted(floor: Shop) -> None:
    job = floor.job()
    run = floor.park(job)
    with floor.client("jobs:write") as writer:
        assert writer.delete(f"/v1/jobs/{job}").status_code == 409
        floor.post(f"/v1/runs/{run['id']}:abort", 202)
        assert writer.delete(f"/v1/jobs/{job}").status_code == 204
    assert floor.get(f"/v1/runs/{run['id']}")["setup"] is None


@pytest.mark.thorough
def test_a_run_goes_on_without_the_server_and_the_next_one_finds_it(tmp_path: Path, mill: Bench) -> None:
    with shop(tmp_path / "data", mill) as floor:
        run = floor.park(floor.job((300,)))
        floor.start(run)
        floor.until_cut(8)
    with shop(tmp_path / "data", mill) as floor:
        floor.until(run, lambda now: now["state"] in ("running", "finished") and not now["unreachable"])
        assert floor.until_finished(run)["share"] == 1.0
    assert mill.cut == ends(300)


@pytest.mark.thorough
@pytest.mark.parametrize("agent_has_it", [False, True])
def test_a_hand_over_cut_short_is_finished_by_the_next_server(tmp_path: Path, mill: Bench, agent_has_it: bool) -> None:
    """The row is there and the answer of the agent was never written down: as after kill -9 in between."""
    with shop(tmp_path / "data", mill) as floor:
        run = floor.park(floor.job())
    with sqlite3.connect(tmp_path / "data" / "causticmill.sqlite") as database:
        database.execute("UPDATE runs SET state = 'preparing', agent_run = NULL, view = NULL")
    if not agent_has_it:
        (tmp_path / "data" / "agents" / MACHINE / "client-keys.json").unlink()
        kill_agents(tmp_path)
    with shop(tmp_path / "data", mill) as floor:
        found = floor.until_state(run, "parked")
        assert found["open"]
        floor.start(found)
        floor.until_finished(run)
    assert mill.cut == ends(LINES[0])


@pytest.mark.thorough
def test_two_servers_of_one_database_see_the_same_runs(tmp_path: Path, mill: Bench) -> None:
    with shop(tmp_path / "data", mill) as floor, api_server(tmp_path / "data") as second:
        run = floor.park(floor.job((500,)))
        with floor.client("machine:run", "jobs:read", address=second.address) as other:
            body = {"job": run["job"]}
            assert other.post(f"/v1/machines/{MACHINE}/runs", json=body).status_code == 409
            said = {"operator": "Ada", "checks": CHECKS}
            assert give(other, f"/v1/runs/{run['id']}:start", json=said).status_code == 202
            floor.until_cut(4)
            assert other.post(f"/v1/runs/{run['id']}:hold").status_code == 202
        floor.until_state(run, "held")


@pytest.mark.thorough
def test_a_run_that_ends_while_nobody_asks_is_closed(
    tmp_path: Path, mill: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the server's own look now and then: figures, deletion and retention see it."""
    monkeypatch.setattr(Fleet.watch, "__defaults__", (0.2,))
    with shop(tmp_path / "data", mill) as floor:
        run = floor.park(floor.job((20,)))
        floor.start(run)
        book = floor.server.services.fleet._core.runs
        until(lambda: not book.get(run["id"]).open)
        assert book.get(run["id"]).state == "finished"
        assert "causticmill_open_runs 0.0" in floor.server.client.get("/metrics").text
