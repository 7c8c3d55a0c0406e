"""The mill runs what programs do beside their cuts: warm-up, a trace with the spindle off, coolant on and off."""

from __future__ import annotations

import pytest

from machines.driver import Faulted, ProgramDone
from machines.simulated.traits import FLUIDNC, GRBL_11, GRBL_11_ECHO, GRBLHAL, Traits
from tests.machines.grbl.bench import Bench, numbered

WARM_UP_S = 300
PROGRAM = (
    b"G21G90G94G17G54|G0Z5|G0X-2Y-2|G1X10F1200|Y8|X-2|Y-2|M3S3000|G4P%d|M3S12000|G4P4|M8|G0X0Y0|Z1|G1Z-0.5F600|X8|Y6|"
    b"G0Z5|M9|M5|M2" % WARM_UP_S
).split(b"|")


@pytest.mark.parametrize("traits", [GRBL_11, GRBL_11_ECHO, GRBLHAL, FLUIDNC], ids=["1.1", "echo", "hal", "fluidnc"])
def test_a_long_warm_up_is_no_fault_and_coolant_runs_while_it_cuts(traits: Traits) -> None:
    """Five minutes without an answer are the program's own; where the mill cuts, spindle and coolant are on."""
    bench = Bench(traits).connected()
    bench.start(numbered(PROGRAM))
    firmware, deep = bench.mill.firmware, []
    while not (bench.of(ProgramDone) or bench.of(Faulted)):
        assert bench.mill.now_s < 2 * WARM_UP_S
        bench.events += bench.driver.poll(0.2)
        if (at := bench.driver.status.work_mm) is not None and at[2] < -0.4:
            deep.append((firmware.spindle, set(firmware.interpreter.coolant)))
    assert not bench.of(Faulted), bench.of(Faulted)
    assert deep[:-1] and all(state == ("M3", {"M8"}) for state in deep[1:-1])
    assert firmware.spindle == "M5" and firmware.interpreter.coolant == set()
    assert bench.mill.now_s > WARM_UP_S


@pytest.mark.parametrize("traits", [GRBL_11, GRBLHAL], ids=["1.1", "hal"])
def test_the_end_of_a_program_switches_coolant_off_even_if_it_does_not_say_so(traits: Traits) -> None:
    bench = Bench(traits).connected()
    bench.run(numbered([line for line in PROGRAM if line not in (b"M9", b"G4P%d" % WARM_UP_S)]), 120.0)
    assert bench.of(ProgramDone) and bench.mill.firmware.interpreter.coolant == set()
