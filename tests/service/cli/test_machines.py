"""`causticmill machines`: all profiles, one in full, and what is wrong with a person's own."""

from __future__ import annotations

from pathlib import Path

import pytest

from cam.posts.dialects import POSTS
from cam.reading.gcode import LANGUAGES
from machines.profile import profile_names
from machines.profile_values import DIALECTS
from service.cli.machines import list_machines, run_machines
from service.errors import InputError, SpecError
from service.job.spec.loading import resolve_job


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    folder = tmp_path / "machines"
    folder.mkdir()
    return folder


def test_every_profile_is_a_row(own: Path) -> None:
    (own / "bench.toml").write_text('extends = "grbl-3018"\ndescription = "mine"\n')
    lines, problems = list_machines()
    assert not problems
    for name in profile_names():
        (row,) = (line for line in lines if line.split(" ")[0] == name)
        assert (str(own) in row) == (name == "bench")
    assert any(str(own) in line and "your own machines" in line for line in lines)


def test_one_in_full_and_an_unknown_one(own: Path) -> None:
    lines, _ = list_machines(name="grbl")
    assert any(line.startswith("acceleration") and "X 400" in line for line in lines)
    with pytest.raises(InputError, match="no machine profile is called 'haas'; known: "):
        list_machines(name="haas")


def test_a_bad_file_does_not_hide_the_others(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (own / "bench.toml").write_text('extends = "grbl"\nsteps = 3\n')
    assert run_machines() == 1
    printed = capsys.readouterr()
    assert "grbl-3018" in printed.out and "bench.toml: steps = 3" in printed.err


def test_check_says_whether_the_port_is_there(own: Path) -> None:
    port = own / "tty"
    (own / "bench.toml").write_text(f'extends = "grbl"\n[link]\nport = "{port}"\n')
    _, problems = list_machines(check=True, name="bench")
    assert len(problems) == 1 and f"bench: port {port}: not there; " in problems[0]
    port.touch()
    lines, problems = list_machines(check=True, name="bench")
    assert not problems and lines[-1] == "no problem found in 1 profile"


def test_a_job_finds_a_profile_of_ones_own_and_says_what_is_wrong_with_it(own: Path) -> None:
    file = own / "bench.toml"
    file.write_text('extends = "grbl"\nsafe_z_mm = 4\n')
    assert resolve_job(base={"machine": {"profile": "bench"}}).machine.safe_z_mm == 4
    file.write_text('extends = "grbl"\nsafe_z_mm = "high"\n')
    with pytest.raises(SpecError, match=r"machine\.profile: 'bench' cannot be used: .*safe_z_mm = 'high'"):
        resolve_job(base={"machine": {"profile": "bench"}})


def test_programs_can_be_written_and_read_for_every_dialect_a_profile_may_have() -> None:
    assert set(POSTS) == set(LANGUAGES) == set(DIALECTS)
    assert {dialect: post.suffix for dialect, post in POSTS.items() if post.suffix != ".nc"} == {
        "linuxcnc": ".ngc",
        "okuma": ".min",
        "rml-1": ".rml",
    }


def test_a_job_takes_a_machine_of_ones_own_and_says_what_is_wrong_with_it(own: Path) -> None:
    (own / "bench.toml").write_text('extends = "grbl-3018"\ntravel_mm = [280, 175, 40]\n')
    machine = resolve_job(overrides=["machine.profile=bench", "machine.safe_z_mm=4"]).machine
    assert (machine.name, machine.travel_mm, machine.safe_z_mm) == ("bench", (280, 175, 40), 4)
    (own / "bench.toml").write_text("travel_mm = [-1, 2, 3]\n")
    with pytest.raises(SpecError, match=r"machine\.profile: 'bench' cannot be used: .*bench\.toml: travel_mm"):
        resolve_job(overrides=["machine.profile=bench"])
