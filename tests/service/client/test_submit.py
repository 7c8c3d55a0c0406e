"""`submit` and `jobs`: one job per command, one line per fault, exit codes as everywhere."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from tests.service.client.shop import ROOT, SHARED, SMALL, BadWire, ShopWithoutWorker, ShopWithWorker, begun, run
from tests.trials.server.deployment import free_port
from tests.waiting import PATIENCE_S


@pytest.mark.thorough
def test_a_picture_becomes_files_with_one_command(working_shop: ShopWithWorker) -> None:
    """Id, stages, then the files; the spec that the server resolved is what was asked for."""
    done = working_shop.made()
    assert done.returncode == 0, done.stderr
    job_id, *lines = done.stdout.splitlines()
    job = httpx.get(f"{working_shop.url}/v1/jobs/{job_id}", trust_env=False, timeout=PATIENCE_S).json()
    assert job["spec"]["optics"]["throw_mm"] == 33
    assert job["spec"]["preset"] == "draft"
    for stage in ("image", "map", "heightfield", "pass-1", "check", "report"):
        assert any(line.startswith(f"{stage}:") for line in lines), done.stdout
    assert {"report.html", "heightfield.npz", "pass-1-rough.nc"} <= {path.name for path in working_shop.out.iterdir()}


@pytest.mark.thorough
def test_jobs_that_differ_in_the_finish_pitch_share_every_stage_before_it(working_shop: ShopWithWorker) -> None:
    """By the events of the second job: the lens, its light and the roughing are taken over, the rest is made."""
    assert working_shop.job()
    words = ("submit", str(working_shop.picture(1)), *SHARED, "--set", "passes.1.pitch_mm=0.3", "--follow", "--quiet")
    done = run(*words, server=working_shop.url)
    assert done.returncode == 0, done.stderr
    events = httpx.get(
        f"{working_shop.url}/v1/jobs/{done.stdout.strip()}/events", trust_env=False, timeout=PATIENCE_S
    ).text
    kinds: dict[str, list[str]] = {"stage.reused": [], "stage.committed": []}
    for kind, stage in re.findall(r'^event: (\S+)\ndata: {"stage":"(\S+?)"', events, flags=re.MULTILINE):
        if kind in kinds:
            kinds[kind].append(stage)
    assert kinds["stage.reused"] == ["image", "irradiance", "map", "heightfield", "caustic", "fit", "pass-1"]
    assert kinds["stage.committed"] == ["pass-2", "check", "as-milled", "report"]


@pytest.mark.parametrize(
    ("name", "kept"),
    [(b"caf\xe9.png", "caf_.png"), ("猫 Ж ü.png".encode(), "猫 Ж ü.png"), (b'say "ah".png', "say _ah_.png")],
)
def test_a_picture_of_any_name_is_taken(shop: ShopWithoutWorker, tmp_path: Path, name: bytes, kept: str) -> None:
    picture = tmp_path / os.fsdecode(name)
    picture.write_bytes(shop.picture(2).read_bytes())
    done = run("submit", str(picture), *SMALL, server=shop.url)
    assert done.returncode == 0, done.stderr
    job = httpx.get(f"{shop.url}/v1/jobs/{done.stdout.strip()}", trust_env=False, timeout=PATIENCE_S).json()
    assert job["name"] == kept


def test_an_answer_that_is_lost_makes_one_job_all_the_same(shop: ShopWithoutWorker) -> None:
    """The first two answers never arrive; the request is sent again with its key."""
    before = shop.count()
    with BadWire(shop.url, lambda number, _came: number <= 2, swallow=True) as wire:
        done = run("submit", str(shop.picture(2)), *SMALL, server=wire.url)
    assert done.returncode == 0, done.stderr
    assert wire.cuts == 2
    assert shop.count() == before + 1


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("--set", "optics.width_mm=-3"), "optics.width_mm: -3 is not allowed; allowed: a number from 0.5"),
        (("--set", "optics.widht_mm=3"), "did you mean 'width_mm'"),
        (("--set", "optics.width_mm=inf"), "optics.width_mm"),
        (("--preset", "golden"), "preset: 'golden' is not allowed"),
        (("--set", "machine.profile=nobody"), "machine.profile: 'nobody' is not known"),
        (("--priority", "urgent"), "--priority: 'urgent' is not allowed; allowed: low, normal, high"),
    ],
)
def test_what_cannot_be_used_is_named_by_its_key(shop: ShopWithoutWorker, words: tuple[str, ...], told: str) -> None:
    before = shop.count()
    done = run("submit", str(shop.picture()), *words, server=shop.url)
    assert done.returncode == 2
    assert told in done.stderr
    assert all(line.startswith("error: ") for line in done.stderr.splitlines())
    assert shop.count() == before


@pytest.mark.thorough
def test_a_file_that_is_no_picture_is_refused(shop: ShopWithoutWorker, tmp_path: Path) -> None:
    (tmp_path / "p.png").write_bytes(b"hello")
    done = run("submit", str(tmp_path / "p.png"), server=shop.url)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1 and "p.png" in done.stderr


@pytest.mark.thorough
def test_no_server_is_one_line() -> None:
    url = f"http://127.0.0.1:{free_port()}"
    for words in (("jobs",), ("submit", str(ROOT / "examples" / "camera.png"))):
        done = run(*words, server=url)
        assert done.returncode == 1
        assert done.stderr.startswith(f"error: no server answers at {url}") and done.stderr.count("\n") == 1


@pytest.mark.thorough
def test_jobs_are_listed_and_shown(shop: ShopWithoutWorker) -> None:
    job_id = shop.job()
    listed = run("jobs", server=shop.url)
    assert listed.returncode == 0
    assert any(job_id in line and "succeeded" in line for line in listed.stdout.splitlines())
    shown = run("jobs", "show", job_id, server=shop.url)
    assert "pass-1-rough.nc" in shown.stdout and "heightfield" in shown.stdout
    unknown = run("jobs", "show", "00000000-0000-4000-8000-000000000000", server=shop.url)
    assert unknown.returncode == 2 and unknown.stderr.count("\n") == 1


@pytest.mark.thorough
def test_ctrl_c_leaves_the_job_alone(working_shop: ShopWithWorker) -> None:
    """The command says that the job goes on, and it does."""
    words = ("submit", str(working_shop.picture()), "--preset", "draft", "--set", "optics.throw_mm=61", "--follow")
    with begun(*words, server=working_shop.url) as process:
        assert process.stdout is not None
        job_id = process.stdout.readline().strip()
        while not process.stdout.readline().startswith("irradiance"):
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert f"the job goes on; `causticmill jobs follow {job_id}`" in errors
    job = httpx.get(f"{working_shop.url}/v1/jobs/{job_id}", trust_env=False, timeout=PATIENCE_S).json()
    assert job["state"] in ("queued", "running")
    cancelled = run("jobs", "cancel", job_id, server=working_shop.url)
    assert cancelled.returncode == 0
    followed = run("jobs", "follow", job_id, server=working_shop.url)
    assert followed.returncode == 1 and "was cancelled" in followed.stderr
    assert run("jobs", "retry", job_id, server=working_shop.url).returncode == 0
    assert run("jobs", "cancel", job_id, server=working_shop.url).returncode == 0
    assert run("jobs", "follow", job_id, "-q", server=working_shop.url).returncode == 1
    assert run("jobs", "delete", job_id, server=working_shop.url).returncode == 0
    assert run("jobs", "show", job_id, server=working_shop.url).returncode == 2


def test_the_client_starts_without_arrays() -> None:
    """Listing jobs needs no numpy: a command that only asks answers at once."""
    code = (
        "import sys; from service.cli.main import run; run(['submit', 'examples/camera.png', '--preset', 'draft']);"
        "run(['jobs']); run(['get', 'x', '-o', '/nowhere/x']);"
        "print(sorted({'numpy', 'numba', 'scipy', 'PIL', 'sqlalchemy', 'dbos', 'fastapi'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
