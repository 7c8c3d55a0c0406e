"""Following outlasts the wire and the server: every stage is told once, in order, to the end."""

from __future__ import annotations

import json
import re
import signal

import httpx
import pytest

from tests.service.client.shop import SMALL, BadWire, ShopWithWorker, begun, run
from tests.trials.server.processes import kill, of_kind
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.thorough


def stages(text: str) -> list[str]:
    return [line.removesuffix(" ...") for line in text.splitlines() if line.endswith(" ...")]


def test_a_wire_that_breaks_hides_nothing(working_shop: ShopWithWorker) -> None:
    """Each connection is cut after a few events; with Last-Event-ID none is missed and none comes twice."""
    with BadWire(working_shop.url, lambda _, came: came.count(b"event: stage.") >= 2) as wire:
        words = ("submit", str(working_shop.picture(3)), *SMALL, "--set", "optics.throw_mm=34", "--follow")
        done = run(*words, server=wire.url)
    assert done.returncode == 0, done.stderr
    assert wire.cuts >= 2
    assert "trying again, the job goes on" in done.stdout
    job_id = done.stdout.splitlines()[0]
    told = httpx.get(f"{working_shop.url}/v1/jobs/{job_id}/events", trust_env=False, timeout=PATIENCE_S).text
    begun_stages = [json.loads(data)["stage"] for data in re.findall(r"event: stage.started\ndata: (.*)", told)]
    assert stages(done.stdout) == begun_stages != []
    ended = run("jobs", "follow", job_id, server=working_shop.url)
    assert ended.returncode == 0 and "succeeded" in ended.stdout


def test_a_server_that_is_killed_is_waited_for(working_shop: ShopWithWorker) -> None:
    """kill -9 of the API while somebody follows: they are told, and see the job succeed."""
    words = ("submit", str(working_shop.picture(4)), *SMALL, "--set", "optics.throw_mm=35", "--follow")
    with begun(*words, server=working_shop.url) as process:
        assert process.stdout is not None
        while not process.stdout.readline().startswith("irradiance"):
            assert process.poll() is None
        assert kill((p.pid for p in of_kind(working_shop.deployment.mark, "api")), signal.SIGKILL) == 1
        out, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, errors
    assert "trying again, the job goes on" in out
    assert "succeeded" in out
