"""The way back to cutting from a terminal: after every alarm, on a locked mill, on one that answers nothing."""

from __future__ import annotations

from pathlib import Path

import pytest

from machines.simulated.traits import Traits
from tests.service.mills import (
    AT_ZERO,
    IN_THE_CUT,
    WHILE_HOMING,
    WITH_SWITCHES,
    ZERO_MM,
    Bench,
    bench,
    ends_on_the_mill,
    fail_homing,
    is_homing,
    program,
    zeroed,
)
from tests.service.terminal import Terminal
from tests.waiting import until

LINES = 60
QUESTIONS = ("tool is in", "zero is set", "stock is clamped", "in the way")
ASKED = "stop here > "


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path / "config"))


def answer(person: Terminal, *more: str) -> None:
    for words in (*QUESTIONS, *more):
        person.sees(words)
        person.types("y\n")


def home(person: Terminal) -> None:
    person.sees("h home")
    person.sees(ASKED)
    person.types("h\n")


def spindle_words(mill: Bench) -> str:
    return "spindle ON" if mill.mill.firmware.spindle_on() else "spindle off"


@pytest.mark.thorough  # as through the other doors
@pytest.mark.parametrize("number", [3, 5, 6, 9])
def test_after_an_alarm_a_person_gets_back_to_cutting(tmp_path: Path, number: int) -> None:
    """One of each kind (all ten: the driver's tests). And what is said of the spindle is true, at every end."""
    path = program(tmp_path / "p.nc", LINES)
    with bench(6.0, traits=WITH_SWITCHES) as mill:
        zeroed(mill)
        with Terminal("stream", str(path), "--port", mill.url) as person:
            home(person)  # locked at power-up
            answer(person)
            until(lambda: len(mill.cut) > 5)
            IN_THE_CUT.get(number, IN_THE_CUT[3])(mill)
            assert person.ends() == 1
            assert f"ALARM:{min(number, 3) if number not in (4, 5) else number}" in person.text or number > 5
            assert "'alarm' at X" in person.text
            assert spindle_words(mill) in person.text
        mill.mill.firmware.settings[130] = 300.0
        if number > 5:
            with Terminal("stream", str(path), "--port", mill.url, "--recover") as person:
                fail_homing(mill, number if number >= 8 else 0)
                home(person)
                if number < 8:
                    until(lambda: is_homing(mill))
                    WHILE_HOMING[number](mill)
                person.sees(f"ALARM:{number}")
                mill.mill.press("close-door")
                fail_homing(mill, 0)
                person.sees(ASKED)
                person.types("\n")
                assert person.ends() == 2
                assert spindle_words(mill) in person.text
        with Terminal("stream", str(path), "--port", mill.url, "--recover") as person:
            home(person)
            answer(person, "position is right")
            person.sees("finished")
            assert person.ends() == 0
            assert spindle_words(mill) == "spindle off"
            assert "spindle off" in person.text
        assert ends_on_the_mill(LINES) <= set(mill.cut)
        assert not mill.mill.firmware.position_lost


@pytest.mark.thorough
def test_an_untrusted_position_is_asked_for_and_refuses_nothing(tmp_path: Path) -> None:
    """$20=1, and the way back in at its usual height would leave the travel: home first, then as high as the mill gets.

    No word of a work zero elsewhere: the part is cut half already.
    """
    path, high_mm = program(tmp_path / "p.nc", LINES), (*ZERO_MM[:2], -3.0)
    with bench(6.0, traits=WITH_SWITCHES) as mill:
        zeroed(mill, high_mm)
        with Terminal("stream", str(path), "--port", mill.url) as person:
            home(person)
            answer(person)
            until(lambda: len(mill.cut) > 5)
            mill.mill.press("reset")
            assert person.ends() == 1
        with Terminal("stream", str(path), "--port", mill.url, "--recover") as person:
            home(person)
            answer(person, "position is right")
            person.sees("finished")
            assert person.ends() == 0
            assert "cannot go on" not in person.text
            assert "elsewhere" not in person.text
        assert ends_on_the_mill(LINES, high_mm) <= set(mill.cut)


@pytest.mark.thorough
def test_a_zero_that_was_set_elsewhere_is_put_back(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LINES)
    with bench(6.0, traits=WITH_SWITCHES) as mill:
        zeroed(mill)
        with Terminal("stream", str(path), "--port", mill.url) as person:
            home(person)
            answer(person)
            until(lambda: len(mill.cut) > 5)
            mill.mill.press("reset")
            assert person.ends() == 1
        zeroed(mill, (-100.0, *ZERO_MM[1:]))
        with Terminal("stream", str(path), "--port", mill.url, "--recover") as person:
            home(person)
            before = person.sees(ASKED)
            assert "G54 differs" in before
            assert "b put the zero back where this program was cut: G10 L2 P1 X-200.000 Y-150.000 Z-40.000" in before
            person.types("b\n")
            answer(person, "position is right")
            person.sees("finished")
            assert person.ends() == 0
        assert ends_on_the_mill(LINES) <= set(mill.cut)


@pytest.mark.thorough
def test_a_locked_mill_is_offered_home_and_unlock_before_the_questions(tmp_path: Path) -> None:
    path = program(tmp_path / "p.nc", LINES)
    with bench(6.0, traits=WITH_SWITCHES) as mill:
        zeroed(mill)
        with Terminal("stream", str(path), "--port", mill.url) as person:
            before = person.sees(ASKED)
            assert all(words in before for words in ("locked", "h home", "u unlock", "MOVES"))
            assert "tool is in" not in before
            person.types("h\n")
            answer(person)
            person.sees("finished")
            assert person.ends() == 0
        assert ends_on_the_mill(LINES) == set(mill.cut)


@pytest.mark.thorough
@pytest.mark.parametrize("yes", [True, False])
def test_a_controller_that_hears_nothing_but_a_reset_is_offered_one(tmp_path: Path, yes: bool) -> None:
    """ALARM:1 came while nobody was connected."""
    path = program(tmp_path / "p.nc", 5)
    traits: Traits = AT_ZERO.with_settings({21: 1})
    with bench(6.0, traits=traits) as mill:
        until(lambda: mill.mill.now_s > 1.0)
        mill.mill.press("limit")
        until(lambda: mill.mill.firmware.critical)
        with Terminal("stream", str(path), "--port", mill.url) as person:
            person.sees("nothing answers")
            person.sees(ASKED)
            person.types("x\n" if yes else "\n")
            if not yes:
                assert person.ends() == 2
                assert mill.mill.firmware.critical
                return
            person.sees("u unlock")
            assert "h home" not in person.text  # it has no switches
            person.types("u\n")
            answer(person)
            person.sees("finished")
            assert person.ends() == 0
