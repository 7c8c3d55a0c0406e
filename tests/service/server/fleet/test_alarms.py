"""After every alarm a person gets back to cutting by REST, and what is said of the spindle meanwhile is true."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.levels import mostly_thorough
from tests.service.mills import (
    IN_THE_CUT,
    WHILE_HOMING,
    WITH_SWITCHES,
    bench,
    ends_on_the_mill,
    fail_homing,
    is_homing,
    zeroed,
)
from tests.service.server.fleet.shop import MACHINE, Shop, give, kill_agents, own_folders, shop, write_profile
from tests.service.server.fleet.test_control import Person, people
from tests.waiting import seen, until

LINES = 60
LEAVE_THE_SPINDLE_ON = (4, 5)


def told(floor: Shop) -> Any:
    return floor.get(f"/v1/machines/{MACHINE}")["mill"]


def look(floor: Shop, good: Callable[[Any], bool]) -> Any:
    """Until what is said of the mill is good; that."""
    return seen(lambda: told(floor), good, every_s=0.05)


def until_told(floor: Shop, state: str) -> Any:
    """The mill is said to be so, and its spindle as it is."""
    spindle_on = floor.bench.mill.firmware.spindle_on
    return look(floor, lambda mill: mill["state"] == state and mill["spindle_on"] is spindle_on())


def until_locked(floor: Shop, number: int) -> None:
    """From the alarm until the lock is cleared: which one it was is said, and that the spindle has stopped."""
    mill = look(floor, lambda mill: mill["state"] == "alarm")
    assert f"ALARM:{number} " in mill["detail"]
    assert mill["alarm"] == number and mill["code"] in ("locked", "locked_until_reset")
    assert not mill["spindle_on"] or number in LEAVE_THE_SPINDLE_ON
    mill = until_told(floor, "alarm")
    assert f"ALARM:{number} " in mill["detail"]


@pytest.fixture
def locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Shop]:
    """A mill with switches is locked at power-up."""
    own_folders(monkeypatch, tmp_path)
    monkeypatch.setattr(Shop, "until_idle", lambda floor: until_told(floor, "alarm"))
    with bench(6.0, traits=WITH_SWITCHES) as mill:
        zeroed(mill)
        write_profile(mill.url, text=f'extends = "grbl"\nhoming = true\n[link]\nport = "{mill.url}"\n')
        try:
            with shop(tmp_path / "data", mill) as floor:
                yield floor
        finally:
            kill_agents(tmp_path)


def home(floor: Shop, person: Person) -> None:
    """Pressed again where the controller was still restarting by itself: it has forgotten the first one, or has homed
    without its agent, which does not trust a place that it did not see homed.
    """

    def press() -> Any:
        person.until_taken("home")
        return look(floor, lambda mill: mill["state"] in ("idle", "alarm"))

    seen(press, lambda mill: mill["state"] == "idle" and mill["position_trusted"])
    until_told(floor, "idle")


@pytest.mark.parametrize("number", mostly_thorough((1, 4, 7, 8), quick=(8,)))
def test_after_an_alarm_a_person_gets_back_to_cutting(locked: Shop, number: int) -> None:
    """One of each kind (all ten: the driver's tests): in the cut, spindle left on, homing, homing that fails."""
    floor, mill, firmware = locked, locked.bench, locked.bench.mill.firmware
    with people(floor) as (ada, _):

        def post(path: str, *statuses: int, **body: Any) -> Any:
            answer = give(ada.http, path, json=body, headers=ada.headers)
            assert answer.status_code in statuses, answer.text
            return answer.json()

        ada.take()
        home(floor, ada)
        run = floor.until_state(post(f"/v1/machines/{MACHINE}/runs", 201, 202, job=floor.job((LINES,))), "parked")
        here = f"/v1/runs/{run['id']}"
        post(f"{here}:start", 202, operator="Ada", checks=run["required_checks"])
        floor.until_cut(6)
        until_told(floor, "run")
        IN_THE_CUT.get(number, IN_THE_CUT[3])(mill)
        run = floor.until_state(run, "interrupted")
        until_locked(floor, min(number, 3) if number > 5 else number)
        firmware.settings[130] = 300.0
        if number > 5:
            fail_homing(mill, number if number >= 8 else 0)
            ada.until_taken("home")
            if number in WHILE_HOMING:
                until(lambda: is_homing(mill))
                WHILE_HOMING[number](mill)
            look(floor, lambda mill: f"ALARM:{number} " in mill["detail"])
            until_locked(floor, number)
            mill.mill.press("close-door")
            fail_homing(mill, 0)
        home(floor, ada)
        plan = seen(lambda: floor.get(f"{here}/recovery"), lambda plan: plan["ready"], every_s=0.1)
        checks = floor.get(here)["required_checks"]
        assert "position" in checks
        post(f"{here}:recover", 202, operator="Ada", checks=checks, plan=plan["plan"])
        until_told(floor, "run")
        floor.until_state(run, "finished")
        until_told(floor, "idle")
    assert ends_on_the_mill(LINES) <= set(mill.cut)
    assert not firmware.spindle_on() and not firmware.position_lost
