"""Roland over RS-232: all bytes once and in order, little queued, nothing called executed that may not be."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import Event, Faulted, MillState, ProgramDone, ProgramLine, Stopped
from machines.profile import LinkSettings
from machines.roland.serial_driver import RolandSerialDriver
from tests.machines.roland.simulated_serial import SimulatedSerialMill

LINK = LinkSettings(driver="roland-serial", baud=9600, flow="rtscts", rx_bytes=2048)


def program(count: int) -> list[ProgramLine]:
    return [ProgramLine(n, 20 * n, f"Z{n * 7},{n % 90},-{n % 50};".encode()) for n in range(1, count + 1)]


def run(driver: RolandSerialDriver, mill: SimulatedSerialMill, most_s: float = 36000.0) -> list[Event]:
    events: list[Event] = []
    while mill.now_s < most_s:
        events += driver.poll(1.0)
        if any(isinstance(event, ProgramDone | Faulted) for event in events):
            return events
    raise AssertionError(f"not done: {driver.status}")


@settings(max_examples=30, deadline=None)
@given(
    count=st.integers(1, 400),
    buffer_bytes=st.integers(128, 4096),
    command_s=st.floats(0.0, 0.3),
)
def test_every_byte_arrives_once_in_order_and_nothing_is_called_executed_too_soon(
    count: int, buffer_bytes: int, command_s: float
) -> None:
    mill = SimulatedSerialMill(buffer_bytes=buffer_bytes, command_s=command_s)
    link = LinkSettings(driver="roland-serial", baud=9600, flow="rtscts", rx_bytes=buffer_bytes)
    driver = RolandSerialDriver(mill, link, planner_blocks=1)
    driver.connect()
    driver.start(iter(program(count)))
    done = False
    while not done:
        done = ProgramDone() in driver.poll(0.5)
        progress = driver.progress
        assert progress.executed_line <= progress.answered_line <= progress.sent_line
        assert progress.executed_line <= max(0, len(mill.executed) - 1)
    mill.run_dry()
    assert bytes(mill.received) == b"".join(line.text + b"\n" for line in program(count))
    assert (mill.overruns, len(mill.executed)) == (0, count)
    assert mill.most_unsent <= 128


def test_hold_lets_out_no_more_than_the_little_that_waits_in_the_port() -> None:
    mill = SimulatedSerialMill(command_s=0.001)
    driver = RolandSerialDriver(mill, LINK)
    driver.connect()
    driver.start(iter(program(500)))
    for _ in range(3):
        driver.poll(1.0)
    driver.hold()
    before = len(mill.received)
    for _ in range(5):
        driver.poll(1.0)
    assert driver.status.state is MillState.HOLDING
    assert len(mill.received) - before <= 128
    driver.resume()
    run(driver, mill)
    assert len(mill.received) == sum(len(line.text) + 1 for line in program(500))


def test_abort_ends_the_sending_and_says_that_the_position_is_not_known() -> None:
    mill = SimulatedSerialMill(command_s=1.0)
    driver = RolandSerialDriver(mill, LINK)
    driver.connect()
    driver.start(iter(program(400)))
    driver.poll(1.0)
    driver.abort()
    assert Stopped(position_kept=False) in driver.poll(0.5)
    sent = len(mill.received) + mill.unsent_bytes()
    driver.poll(2.0)
    mill.run_dry()
    assert len(mill.received) == sent
