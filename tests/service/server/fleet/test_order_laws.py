"""An order acts within its time or never, and a stop is the last word: over late, doubled, lost and refused messages,
orders without a grant, stalls of the database, disks that hang at any write, restarts and suspended computers.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path
from random import Random
from typing import ClassVar

from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from machines.mill.orders import CARRY_OUT_S, GRANT_S, Stop
from machines.preflight.preflight import Preflight
from machines.profile import load_profile
from service.milling.preflight import run_preflight
from tests.service.server.fleet.order_network import Weather
from tests.service.server.fleet.order_people import ASK_S
from tests.service.server.fleet.order_world import World

HANGS_S = (1.0, 4.0, 9.0, 15.0, 15.0, 20.0)
HUNG_WRITES = (0, 0, 0, 1, 1, 2, 3, 4, 5, 6, 7)  # a resume writes once; a start has written 8 times when the mill cuts
HUNG_ORDERS = ("start", "start", "recover", "resume run", "resume run", "probe", "override", "jog")
DELAYS_S = (0.05, 0.4, 1.2, 1.9, 2.5, 3.5, 6.0, 11.0, 40.0)
LINES = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", "G0 X1 Y0", "G1 Z-1 F200"]
LINES += [f"G1 X{1 + i % 40} Y{i // 40} F600" for i in range(200)] + ["G0 Z5", "M5", "M2"]
BODIES = {
    "jog": {"by_mm": [1.0, 0.0, 0.0], "feed_mm_per_min": 600},
    "zero": {"axes": "XYZ"},
    "probe": {"depth_mm": 2.0, "feed_mm_per_min": 600},
    "override": {"what": "feed", "percent": 120},
    "block": {"text": "G4 P0.1"},
    "resume": {},
}
ORDERS = ("jog", "zero", "probe", "override", "block", "resume", "start", "recover", "resume run")
ASK_FIRST = ("start", "recover", "probe", "override")
EVENTS = (
    *("nothing",) * 8, *Stop, Stop.HOLD, Stop.HOLD, "take over", "take over", "give back", "server restarts",
    "agent restarts", "sleep", "zero", "zero",
)  # fmt: skip


@cache
def program() -> tuple[Preflight, Path]:
    folder = Path(tempfile.mkdtemp(prefix="order-laws-"))
    path = folder / "p.nc"
    path.write_text("\n".join(LINES) + "\n")
    return run_preflight(path, load_profile("grbl"), settings=None, cache=folder / "cache"), path


class OrderHistories(RuleBasedStateMachine):
    """People press, the network does as it likes; what leaves for the mill is held against the laws."""

    tally: ClassVar[Counter[str]] = Counter()

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory(prefix="order-laws-")
        self.world = World(Path(self.folder.name), program())
        self.world.pass_s(1.0)

    def teardown(self) -> None:
        if hasattr(self, "world"):
            self.world.pass_until_all_came(41.0)
            self.judge(1.0)
            self.world.close()
            OrderHistories.tally.update(["histories", *self.world.judged, *["hung"] * self.world.hung])
            self.folder.cleanup()

    @rule(number=st.integers(0, 1 << 32))
    def press(self, number: int) -> None:
        """Somebody presses, some of the messages are late, and something happens meanwhile.

        number : with that of the history and of the press it decides all that follows; by itself it would often be 0

        late : seconds by message, in the order in which they are sent: page to server, back, server to agent, back,
               for the grant and then for the order
        """
        world = self.world
        chance = Random(f"{number} {self.tally['histories']} {len(world.people.presses)}")
        event, hangs = chance.choice(EVENTS), chance.random() < 0.5
        what = chance.choice(("start", "recover") if event == "zero" else HUNG_ORDERS if hangs else ORDERS)
        self.judge(chance.choice((0.0, 0.5, 3.0)))
        seen = world.make_ready(what)
        self.judge(0.0)
        way = chance.choice(("page",) * 6 + ("curl", "curl", "bare"))
        world.gate.release_lease(self.secret)
        in_control = what in BODIES or chance.random() < 0.5
        self.secret = (world.take_control(take_over=True) or "") if in_control else ""
        world.pass_s(0.3)
        world.database_s = chance.choice((0.0,) * 8 + (0.5, 20.0))
        late = {chance.randrange(8): chance.choice(DELAYS_S) for _ in range(chance.choice((0, 1, 1, 1, 2)))}
        if way == "curl" and chance.random() < 0.5:
            late = {2: chance.choice((0.4, 1.2, 1.9))}  # on the way to the agent, where a stop may overtake the asking
        delays_s = [late.get(number, 0.002) for number in range(8)]
        twice_s = {chance.randrange(4): chance.choice((0.0, 0.1, 1.0, 4.0))} if chance.random() < 0.4 else {}
        lost, refused = chance.choice((-1,) * 9 + (0, 1, 2, 3)), chance.choice((-1,) * 14 + (0, 2))
        if hangs:
            world.hang_in, world.hang_s = chance.choice(HUNG_WRITES), chance.choice(HANGS_S)
        if hangs and chance.random() < 0.7:  # a good network, or few orders would come as far as the disk
            world.database_s, delays_s, twice_s, lost, refused = 0.0, [], {}, -1, -1
        weather = Weather(list(delays_s), twice_s, lost, refused)
        shown = seen if way == "page" or what == "recover" else ""  # without its plan a recovery is refused anyway
        world.people.press(what, self.secret, weather, way=way, seen=shown, body=BODIES.get(what))
        world.pass_s(chance.uniform(0.0, min(sum(delays_s), 5.0)))
        self.happen(event)
        if chance.random() < 0.5:
            world.pass_until_all_came(13.0)
        self.judge(0.5)

    secret = ""

    def happen(self, event: str) -> None:
        world = self.world
        match event:
            case "hold" | "abort" | "jog-cancel":
                world.people.press_stop(Stop(event))
            case "take over":
                self.secret = world.take_control(take_over=True) or ""
            case "give back":
                world.gate.release_lease(self.secret)
            case "server restarts":
                world.restart_server()
            case "agent restarts":
                world.restart_agent()
                world.pass_s(2.0)
            case "sleep":
                world.suspend(4.0)
            case "zero":
                world.set_zero()

    # ------------------------------------------------------------------ laws

    def judge(self, settle_s: float) -> None:
        world = self.world
        world.pass_s(settle_s)
        for act in world.take_acts():
            press = world.people.presses[act.press]
            assert press.way != "bare", f"{act} without a grant: {press}"
            limit_s = ASK_S + (CARRY_OUT_S if act.what in ASK_FIRST else GRANT_S)
            assert act.at_s <= press.at_s + limit_s + 0.2, f"{act} was late: {press}"
            later = [one for one in world.people.stops[press.stops_before :] if one.reached_s is not None]
            assert not any(one.reached_s < act.at_s for one in later), f"{act} after a later stop: {press}, {later}"
            digest = hashlib.sha256(press.control.encode()).hexdigest() if act.lease or press.control else ""
            assert act.lease == digest, f"{act} under another lease: {press}"
            assert not press.seen or act.seen == press.seen, f"{act} for another plan: {press}"
            press.acts += 1
            assert press.acts == 1, f"{act} came true twice: {press}"
        reached = [one for one in world.people.stops if one.reached_s is not None]
        assert all(one.written for one in reached), "a stop waited"
        assert all(one.outcome in ("taken", "under way") for one in reached), (
            f"a stop that left is no success: {reached}"
        )


def run_histories(count: int, *, derandomize: bool = True) -> Counter[str]:
    """Judge so many histories; how many there were, and how often which order came true. AssertionError."""
    OrderHistories.tally = Counter()
    asked = settings(
        max_examples=count,
        stateful_step_count=4,
        deadline=None,
        derandomize=derandomize,
        database=None,
        phases=[Phase.generate],  # a history says all there is to know: making it smaller takes minutes
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(OrderHistories, settings=asked)
    return OrderHistories.tally


def test_every_order_acts_for_its_moment_and_every_stop_is_the_last_word() -> None:
    tally = run_histories(100)
    assert tally["histories"] >= 100 and tally["hung"] and all(tally[what] for what in set(ORDERS)), tally
