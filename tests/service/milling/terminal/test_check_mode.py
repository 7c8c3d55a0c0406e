"""A dry run leaves check mode, whenever its person interrupts it: in check mode the mill would move nothing in the next
run, and nobody would see why.
"""

from __future__ import annotations

from typing import Any

import pytest

from machines.driver import MillState
from machines.simulated.traits import GRBL_11, GRBLHAL, Traits
from service.milling.terminal.ready import run_check_mode
from tests.machines.grbl.bench import Bench, spiral

_LINES, _ = spiral(4000)


class Interrupted:
    """A driver whose poll is interrupted once, at the first moment at which `comes` holds."""

    def __init__(self, bench: Bench, comes: Any) -> None:
        self.bench, self.comes, self.came = bench, comes, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.bench.driver, name)

    def poll(self, timeout_s: float) -> Any:
        if not self.came and self.comes(self.bench):
            self.came = True
            raise KeyboardInterrupt
        return self.bench.driver.poll(timeout_s)


def in_check(bench: Bench) -> bool:
    return bench.mill.firmware.state == "Check"


def has_answers(count: int) -> Any:
    return lambda bench: bench.driver.progress.answered_line >= count


@pytest.mark.parametrize("traits", [GRBL_11, GRBLHAL], ids=["grbl 1.1", "grblHAL"])
@pytest.mark.parametrize(
    "comes",
    [
        in_check,
        lambda bench: bench.driver.progress.streaming,
        has_answers(1),
        has_answers(700),
        has_answers(len(_LINES) - 12),
    ],
    ids=["the controller has taken $C", "the first lines are on their way", "one line", "700 lines", "the last lines"],
)
def test_an_interrupt_leaves_check_mode_and_an_idle_mill(traits: Traits, comes: Any) -> None:
    bench = Bench(traits)
    driver = Interrupted(bench, comes)
    with pytest.raises(KeyboardInterrupt):
        run_check_mode(driver, "memory", iter(_LINES), lambda line: None)  # type: ignore[arg-type]
    assert driver.came
    bench.pass_time(2.0)
    assert bench.mill.firmware.state == "Idle" and bench.state() is MillState.IDLE
    assert not bench.driver.progress.streaming and not bench.mill.recording.segments
    lines, _ = spiral(3)
    bench.run(lines)  # the next run moves
    assert bench.mill.recording.segments
