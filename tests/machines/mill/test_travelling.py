"""Ways at a safe height: up, across, down; refused as a whole or gone within the travel; nothing moves after a stop."""

from __future__ import annotations

import random
import tempfile
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from machines.driver import Home, Jog, JogCancel, MillState, SendBlock, SetZero
from machines.errors import NotAllowedError
from machines.mill.orders import Caller, OrderRefusedError, Stop
from machines.preflight.preflight import Bounds
from tests.machines.shop import LINES, Shop
from tests.trials.kill_bench import Bench

SAFE_MM = 5.0  # of the bench
BOX = Bounds((10.0, 10.0, -1.0), (49.5, 11.0, 5.0))  # of LINES
SPANS = [st.floats(low, -0.5).map(lambda mm: round(mm, 2)) for low in (-290.0, -290.0, -75.0)]
PLACES = st.tuples(*SPANS)
STOPS = (Stop.HOLD, Stop.ABORT, Stop.JOG_CANCEL)


class Homed(Shop):
    """A homed mill with a parked program, its work zero at a place in machine coordinates."""

    def __init__(self, folder: Path, *, zero_mm: tuple[float, float, float] | None = (-150.0, -150.0, -50.0)) -> None:
        super().__init__(folder, LINES)
        self.mill.close()
        self.bench = Bench(folder / "homed", random.Random(1), homing=True, hal=False)
        self.bench.until_state(MillState.IDLE, MillState.ALARM)
        self.bench.command_done(Home())
        self.facts = replace(self.facts, bounds_by_frame={"G54": BOX})
        self.id = self.mill.park(self.facts, self.path, "part").id
        if zero_mm is not None:
            self.go_to(zero_mm)
            self.bench.command_done(SetZero("XYZ"))
        self.pass_s(1.0)  # until the controller reports the zero

    def go_to(self, place_mm: tuple[float, float, float]) -> None:
        x, y, z = place_mm
        self.bench.command_done(SendBlock(f"G53 G0 X{x:.3f} Y{y:.3f} Z{z:.3f}"))

    def give(self, what: str, *about: object) -> None:
        caller = Caller(name="Ada", grant=self.mill.orders.issue_grant().word)
        self.mill.carry_out(what, lambda mill: getattr(mill, what)(*about), caller)

    def stop(self, stop: Stop) -> None:
        self.mill.orders.count_stop()
        self.mill.carry_out_stop(stop, Caller())

    def stand(self) -> None:
        """Wait until it has stood for a while: between two legs it stands, too."""
        before = None
        while before != self.place_mm:
            before = self.place_mm
            self.pass_s(2.0)

    @property
    def place_mm(self) -> tuple[float, float, float]:
        x, y, z = self.mill.status.machine_mm
        return x, y, z

    def jogs(self) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
        """Each motion of a jog that the simulated mill has carried out, as its own parser has read it; machine mm."""
        segments = self.bench.sim.recording.segments
        shift = [at - end for at, end in zip(self.place_mm, segments[-1].end, strict=True)]
        places = [
            [tuple(a + b for a, b in zip(place, shift, strict=True)) for place in (one.start, one.end)]
            for one in segments
            if one.kind == "jog"
        ]
        return [(start, end) for start, end in places]


def is_across(start_mm: tuple[float, ...], end_mm: tuple[float, ...]) -> bool:
    return any(abs(a - b) > 1e-6 for a, b in zip(start_mm[:2], end_mm[:2], strict=True))


@settings(max_examples=12, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(zero_mm=PLACES, begin_mm=PLACES, axes=st.sampled_from(["XY", "XYZ"]), feed=st.sampled_from([1000.0, 3000.0]))
def test_a_way_to_zero_goes_up_then_across_then_down_within_the_travel_or_not_at_all(
    zero_mm: tuple[float, float, float], begin_mm: tuple[float, float, float], axes: str, feed: float
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shop = Homed(Path(folder), zero_mm=zero_mm)
        shop.go_to(begin_mm)
        height_mm = max(begin_mm[2], zero_mm[2] + SAFE_MM)
        before = len(shop.jogs())
        if height_mm > 0.01:
            with pytest.raises(NotAllowedError, match="machine reaches"):
                shop.give("go_to_zero", axes, feed)
            shop.stand()
            assert len(shop.jogs()) == before
            return
        shop.give("go_to_zero", axes, feed)
        shop.stand()
        x_mm, y_mm, _ = zero_mm
        assert shop.place_mm == pytest.approx((x_mm, y_mm, height_mm if axes == "XY" else zero_mm[2]), abs=0.02)
        for start_mm, end_mm in shop.jogs()[before:]:
            if is_across(start_mm, end_mm):
                assert min(start_mm[2], end_mm[2]) >= height_mm - 0.02


def test_a_frame_goes_around_the_outline_above_the_program(tmp_path: Path) -> None:
    shop = Homed(tmp_path)
    before = len(shop.jogs())
    shop.give("frame", shop.facts.sha256, 2000.0)
    shop.stand()
    ends = [end_mm for start_mm, end_mm in shop.jogs()[before:] if is_across(start_mm, end_mm)]
    around = [(round(x + 150.0, 2), round(y + 150.0, 2)) for x, y, _ in ends]
    assert around == [(10.0, 10.0), (49.5, 10.0), (49.5, 11.0), (10.0, 11.0), (10.0, 10.0)]
    assert all(z == pytest.approx(-50.0 + SAFE_MM, abs=0.02) for *_, z in ends)
    assert shop.state.value == "parked"


@settings(max_examples=20, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
@given(after_s=st.floats(0.0, 8.0), stop=st.sampled_from(STOPS), way=st.sampled_from(["go_to_zero", "frame"]))
def test_nothing_moves_after_a_stop_between_legs_or_on_one(after_s: float, stop: Stop, way: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        shop = Homed(Path(folder))
        shop.bench.command_done(Jog((20.0, 30.0, 0.0), 3000.0))
        shop.give(*(("go_to_zero", "XY", 1000.0) if way == "go_to_zero" else ("frame", shop.facts.sha256, 1000.0)))
        shop.pass_s(after_s)
        shop.stop(stop)
        shop.stand()
        stood_mm, count = shop.place_mm, len(shop.jogs())
        shop.pass_s(6.0)
        assert (shop.place_mm, len(shop.jogs())) == (stood_mm, count)


def test_a_change_of_control_ends_a_way_after_the_leg(tmp_path: Path) -> None:
    shop = Homed(tmp_path)
    secret, _, _ = shop.mill.orders.take_lease("Ada", "ada")
    caller = Caller(name="Ada", grant=shop.mill.orders.issue_grant(secret).word)
    shop.mill.carry_out("frame", lambda mill: mill.frame(shop.facts.sha256, 1000.0), caller, needs_lease=True)
    shop.pass_s(0.5)
    shop.mill.orders.take_lease("Bob", "bob", take_over=True)
    shop.stand()
    assert len([one for one in shop.jogs() if is_across(*one)]) <= 1
    assert any("changed hands" in entry.words for entry in shop.mill.snapshot.events)


def test_the_end_of_a_jog_ends_a_way_without_a_count_of_stops_too(tmp_path: Path) -> None:
    shop = Homed(tmp_path)
    shop.mill.go_to_zero("XYZ", 1000.0)
    shop.mill.command(JogCancel())
    shop.stand()
    assert any("ended on the way" in entry.words for entry in shop.mill.snapshot.events)


def test_a_leg_that_ends_elsewhere_is_the_last(tmp_path: Path) -> None:
    """By a button of the mill itself, which no order is."""
    shop = Homed(tmp_path)
    shop.give("frame", shop.facts.sha256, 1000.0)
    shop.bench.until(lambda: shop.place_mm[0] > -148.0)
    shop.mill._link.driver._port.write(b"\x85")
    shop.stand()
    assert shop.place_mm[0] < -140.5
    assert any("ended on the way" in entry.words for entry in shop.mill.snapshot.events)


def test_a_way_is_refused_where_place_zero_or_program_is_not_known(tmp_path: Path) -> None:
    for number, (zero_mm, begin, refusal) in enumerate((
        (None, (), "work zero of X, Y, Z is not set"),
        ((-150.0, -150.0, -50.0), (SendBlock("G55"),), "works in G54, the controller is in G55"),
        ((-150.0, -150.0, -50.0), (SendBlock("M3 S1000"),), "spindle must be off"),
        ((-10.0, -10.0, -50.0), (), "machine reaches"),
    )):  # fmt: skip
        folder = tmp_path / str(number)
        folder.mkdir()
        shop = Homed(folder, zero_mm=zero_mm)
        for command in begin:
            shop.bench.command_done(command)
        before = len(shop.jogs())
        order = ("go_to_zero", "XYZ", 500.0) if "spindle" in refusal else ("frame", shop.facts.sha256, 500.0)
        with pytest.raises(NotAllowedError, match=refusal):
            shop.give(*order)
        with pytest.raises(NotAllowedError, match="does not wait on the mill"):
            shop.give("frame", "0" * 64, 500.0)
        shop.stand()
        assert len(shop.jogs()) == before


def test_a_begun_order_has_no_age_but_ends_with_a_stop(tmp_path: Path) -> None:
    shop = Homed(tmp_path)
    permit = shop.mill.orders.redeem(shop.mill.orders.issue_grant().word, "frame")
    permit.note_begun()
    permit._grant = permit._grant.__class__(word="", issued_s=-1e9, stops=0, halts=0, lease=None)
    permit.require()
    shop.mill.orders.count_stop()
    with pytest.raises(OrderRefusedError):
        permit.require()


def test_a_zero_that_the_mill_has_not_reported_yet_is_no_zero_to_go_to(tmp_path: Path) -> None:
    """The status has the old offset for a second after the order that has changed it."""
    shop = Homed(tmp_path)
    shop.bench.command_done(Jog((10.0, 0.0, 0.0), 3000.0))
    shop.bench.command_done(SetZero("X"))
    with pytest.raises(NotAllowedError, match="wait a second"):
        shop.give("go_to_zero", "XY", 1000.0)
    shop.pass_s(1.0)
    shop.give("go_to_zero", "XY", 1000.0)
