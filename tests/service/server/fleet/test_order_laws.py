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

from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from machines.mill.orders import CARRY_OUT_S, GRANT_S, Stop
from machines.preflight.preflight import Preflight
from machines.profile import load_profile
from service.milling.preflight import run_preflight
from tests.service.server.fleet.order_network import Weather
from tests.service.server.fleet.order_people import ASK_S
from tests.service.server.fleet.order_world import World

STORIES = ("weather",) * 7 + ("disk",) * 6 + ("disk and weather",) * 2 + ("overtaken",) * 3 + ("stale",) * 2
"""Of a press: bad weather between all, a disk that hangs, a stop that overtakes the order, or another setup by then."""
HANGS_S = (1.0, 4.0, 9.0, 15.0, 15.0, 20.0)
HUNG_WRITES, HUNG_AT_ONCE = range(9), (0, 0, 1)  # a start has written 8 times when the mill cuts, a resume once
WAYS = ("go-to-zero", "frame")
HUNG_ORDERS = ("start", "start", "recover", "resume run", "resume", "probe", "override", "jog", "spindle", *WAYS)
DELAYS_S = (0.05, 0.4, 1.2, 1.9, 2.5, 3.5, 6.0, 11.0, 40.0)
STALLS_S = (0.0,) * 8 + (0.5, 4.0, 9.0, 20.0)
LINES = ["G21 G90 G94 G17 G54", "M3 S12000", "G0 Z5", "G0 X1 Y0", "G1 Z-1 F200"]
LINES += [f"G1 X{1 + i % 40} Y{i // 40} F600" for i in range(200)] + ["G0 Z5", "M5", "M2"]
BODIES = {
    "jog": {"by_mm": [1.0, 0.0, 0.0], "feed_mm_per_min": 600},
    "go-to-zero": {"axes": "XYZ", "feed_mm_per_min": 300},
    "frame": {"feed_mm_per_min": 1000},
    "spindle": {"on": True, "rpm": 9000},
    "zero": {"axes": "XYZ"},
    "probe": {"depth_mm": 2.0, "feed_mm_per_min": 600},
    "override": {"what": "feed", "percent": 120},
    "block": {"text": "G4 P0.1"},
    "resume": {},
}
ORDERS = ("jog", *WAYS, "spindle", "probe", "override", "resume", "start", "recover", "resume run")
ORDERS += ("zero", "block") * 2  # few of them come true
ASK_FIRST = ("start", "recover", "probe", "override")
SEEDS = st.integers(0, (1 << 24) - 1)  # all alike: of a wider range hypothesis draws small numbers more often
EVENTS = (
    *("nothing",) * 8, *Stop, Stop.HOLD, Stop.HOLD, "take over", "take over", "give back", "server restarts",
    "agent restarts", "sleep",
)  # fmt: skip


@cache
def program() -> tuple[Preflight, Path]:
    folder = Path(tempfile.mkdtemp(prefix="order-laws-"))
    path = folder / "p.nc"
    path.write_text("\n".join(LINES) + "\n")
    return run_preflight(path, load_profile("grbl"), settings=None, cache=folder / "cache"), path


class OrderHistory:
    """People press, the network does as it likes; what leaves for the mill is held against the laws.

    seed : decides all of it, so that a history that breaks a law breaks it each time
    """

    def __init__(self, seed: int, folder: Path) -> None:
        self.chance = Random(seed)
        self.secret = ""
        self.world = World(folder, program())

    def run(self) -> Counter[str]:
        """Judge it; what came true in it. AssertionError."""
        self.world.pass_s(1.0)
        for _ in range(self.chance.choice((2, 3, 4))):
            self.press()
        self.world.pass_until_all_came(41.0)
        self.judge(1.0)
        return Counter(["histories", *self.world.judged, *["hung"] * self.world.hung])

    def press(self) -> None:
        """Somebody presses, some of the messages are late, and something happens meanwhile.

        late : seconds by message, in the order in which they are sent: page to server, back, server to agent, back,
               for the grant and then for the order
        """
        world, chance = self.world, self.chance
        story, event = chance.choice(STORIES), chance.choice(EVENTS)
        what = chance.choice({"stale": ("start", "recover"), "disk": HUNG_ORDERS}.get(story, ORDERS))
        way = chance.choice(("page",) * 5 + ("curl",) * 3 + ("bare",))
        self.judge(chance.choice((0.0, 0.5, 3.0)))
        seen = world.make_ready(what)
        self.judge(0.0)
        world.gate.release_lease(self.secret)
        in_control = what in BODIES or chance.random() < 0.5
        self.secret = (world.take_control(take_over=True) or "") if in_control else ""
        world.pass_s(0.3)
        weather, late = Weather(), {}
        if "weather" in story:
            world.stall_database(chance.choice(STALLS_S))
            late = {chance.randrange(8): chance.choice(DELAYS_S) for _ in range(chance.choice((0, 1, 1, 1, 2)))}
            twice = {chance.randrange(4): chance.choice((0.0, 0.1, 1.0, 4.0))}
            weather.twice_after_s = twice if chance.random() < 0.4 else {}
            weather.lost = chance.choice((-1,) * 9 + (0, 1, 2, 3))
            if (crowd := chance.choice((None,) * 10 + ("strangers", "strangers", "at work"))) is not None:
                world.crowd_server(strangers=crowd == "strangers")
        if "disk" in story:
            world.hang_in = chance.choice(HUNG_WRITES if what in ("start", "recover") else HUNG_AT_ONCE)
            world.hang_s = chance.choice(HANGS_S)
        if story == "overtaken":  # the asking for a grant, by a stop that leaves the mill ready for the order
            late = {chance.choice((0, 2) if way == "page" else (2,)): chance.choice((0.4, 1.2, 1.9))}
            event = Stop.HOLD if what.startswith("resume") else Stop.JOG_CANCEL
        if story == "stale":  # what the person has seen
            world.set_zero()
            event = "nothing"
        weather.delays_s = [late.get(number, 0.002) for number in range(8)]
        shown = seen if way == "page" or what == "recover" else ""  # without its plan a recovery is refused anyway
        body = BODIES.get(what, {}) | ({"program": program()[0].sha256} if what == "frame" else {})
        world.people.press(what, self.secret, weather, way=way, seen=shown, body=body)
        meanwhile_s = {"disk": 5.0, "overtaken": 0.3}.get(story, min(sum(late.values()), 5.0))
        meanwhile_s += 4.0 * (what in WAYS)  # a stop between two legs
        world.pass_s(chance.uniform(0.01, 0.01 + meanwhile_s))
        self.happen(event)
        if chance.random() < 0.5:
            world.pass_until_all_came(13.0)
        self.judge(0.5)

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

    # ------------------------------------------------------------------ laws

    def judge(self, settle_s: float) -> None:
        world = self.world
        world.pass_s(settle_s)
        for act in world.take_acts():
            press = world.people.presses[act.press]
            assert press.way != "bare", f"{act} without a grant: {press}"
            limit_s = ASK_S + (CARRY_OUT_S if act.what in ASK_FIRST else GRANT_S)
            assert act.goes_on or act.at_s <= press.at_s + limit_s + 0.2, f"{act} was late: {press}"
            later = [one for one in world.people.stops[press.stops_before :] if one.reached_s is not None]
            assert not any(one.reached_s < act.at_s for one in later), f"{act} after a later stop: {press}, {later}"
            digest = hashlib.sha256(press.control.encode()).hexdigest() if act.lease or press.control else ""
            assert act.lease == digest, f"{act} under another lease: {press}"
            assert not press.seen or act.seen == press.seen, f"{act} for another plan: {press}"
            press.acts += not act.goes_on
            assert press.acts == 1, f"{act} came true twice: {press}"
        stops = world.people.stops
        assert all(one.reached_s is not None and one.reached_s <= one.at_s + 0.1 for one in stops), f"late: {stops}"
        assert all(one.written for one in stops), f"a stop waited: {stops}"
        assert all(one.outcome in ("taken", "under way") for one in stops), f"a stop that left is no success: {stops}"


def run_histories(count: int, *, derandomize: bool = True) -> Counter[str]:
    """Judge so many histories; how many there were, and how often which order came true. AssertionError."""
    tally: Counter[str] = Counter()

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=derandomize,
        database=None,
        phases=[Phase.generate],  # a history says all there is to know: a smaller seed is no smaller history
        suppress_health_check=list(HealthCheck),
    )
    @given(SEEDS)
    def judge_history(seed: int) -> None:
        with tempfile.TemporaryDirectory(prefix="order-laws-") as folder:
            history = OrderHistory(seed, Path(folder))
            try:
                tally.update(history.run())
            finally:
                history.world.close()

    judge_history()
    return tally


def test_every_order_acts_for_its_moment_and_every_stop_is_the_last_word() -> None:
    tally = run_histories(120)
    expected = {*ORDERS, *(f"{way} goes on" for way in WAYS)}
    assert tally["histories"] >= 120 and tally["hung"] and all(tally[what] for what in expected), tally
