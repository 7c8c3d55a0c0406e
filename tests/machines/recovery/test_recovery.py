"""Laws of the way back: never past what was executed, never across without being up, never on doubt."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from machines.driver import MillState, MillStatus
from machines.errors import MillCode
from machines.gcode.interpreter import Interpreter
from machines.gcode.modal import ModalState
from machines.gcode.program import ProgramReader
from machines.grbl.settings import FRAME_SETTINGS, ControllerSettings
from machines.preflight.preflight import Preflight
from machines.recovery.needs import position_doubt
from machines.recovery.plan_model import Need, Present, RecoveryPlan, Reentry
from machines.recovery.planner import plan_recovery
from phrases.phrase import Phrase
from tests.trials.kill_program import facts_of

HEAD = ["G21 G90 G94 G17 G54", "M3 S12000", "M8", "G0 Z5", "G0 X10 Y10", "G1 Z-1 F200"]
RASTER = [
    f"X{x}Y{y}Z-{1 + (x % 3) / 10}{'F900' if x == 11 and y == 10 else ''}" for y in (10, 11) for x in range(11, 19)
]
TAIL = ["G0 Z5", "M5", "M2"]
REENTRY = Reentry(safe_z_mm=5.0)
IDLE = MillStatus(state=MillState.IDLE, work_mm=(3.0, 4.0, -1.2), machine_mm=(3.0, 4.0, -1.2), position_trusted=True)
OFFSETS = {"G54": (0.0, 0.0, 0.0), "G55": (1.0, 2.0, 3.0), "G92": (0.0, 0.0, 0.0), "TLO": (0.0, 0.0, 0.0)}
NOW = Present(status=IDLE, offsets=OFFSETS, parser_state="G1 G54 G17 G21 G90 G94 M3 M8 T0 F900 S12000")


class Shop:
    """A program on disk and what pre-flight knows of it."""

    def __init__(self, folder: Path, lines: list[str], every_lines: int = 5) -> None:
        self.lines = lines
        self.path = folder / "p.nc"
        self.path.write_text("\n".join(lines) + "\n")
        self.facts: Preflight = facts_of(self.path, every_lines)
        self.record: dict[str, Any] = {
            "id": "r", "sha256": self.facts.sha256, "offsets": OFFSETS, "position_trusted": True,
        }  # fmt: skip

    def plan(self, executed: int, present: Present = NOW, **record: Any) -> RecoveryPlan:
        reader = ProgramReader(self.path, self.facts.index)
        return plan_recovery(self.record | {"executed_line": executed} | record, self.facts, reader, present, REENTRY)

    def sent(self, plan: RecoveryPlan) -> list[tuple[int, str]]:
        reader = ProgramReader(self.path, self.facts.index)
        return [(line.number, line.text.decode()) for line in plan.lines(reader)]


@pytest.fixture
def raster(tmp_path: Path) -> Shop:
    return Shop(tmp_path, HEAD + RASTER + TAIL)


def ends(sent: list[tuple[int, str]], start: ModalState) -> list[tuple[int, Any]]:
    """(line, step) of everything sent, carried out by the reader of programs."""
    interpreter = Interpreter(start)
    return [(number, interpreter.take(text.encode())) for number, text in sent]


@pytest.mark.parametrize("executed", range(len(HEAD + RASTER + TAIL) + 1))
def test_no_line_is_skipped_and_the_cut_is_joined(raster: Shop, executed: int) -> None:
    """What is sent begins at or before the first line not executed, with the tool where the program has it there."""
    plan = raster.plan(executed)
    assert plan.ready, (plan.refusals, plan.needs)
    assert plan.resume_line == executed + 1
    assert plan.overlap_line <= plan.resume_line
    sent = raster.sent(plan)
    numbers = [number for number, _ in sent if number]
    assert numbers == list(range(plan.overlap_line, len(raster.lines) + 1))
    whole = dict(ends(list(enumerate(raster.lines, 1)), ModalState()))
    for number, step in ends(sent, ModalState(position_mm=(3.0, 4.0, -1.2))):
        if number and step.moves and plan.position_mm is not None:
            same = whole[number]
            assert (step.kind, step.start_mm, step.end_mm, step.feed_mm_per_min) == (
                same.kind, same.start_mm, same.end_mm, same.feed_mm_per_min)  # fmt: skip


@pytest.mark.parametrize("executed", range(6, len(HEAD + RASTER) + 1))
def test_overlap_is_one_move(raster: Shop, executed: int) -> None:
    plan = raster.plan(executed)
    assert plan.overlap_line == executed


@given(executed=st.integers(7, 20), z=st.floats(-30, 40), x=st.floats(-50, 50))
@settings(max_examples=60, deadline=None)
def test_up_before_across_before_down_and_the_spindle_first(executed: int, z: float, x: float) -> None:
    with TemporaryDirectory() as folder:
        shop = Shop(Path(folder), HEAD + RASTER + TAIL)
        status = dataclasses.replace(IDLE, work_mm=(x, 4.0, z), machine_mm=(x, 4.0, z))
        plan = shop.plan(executed, dataclasses.replace(NOW, status=status))
    interpreter = Interpreter(ModalState(position_mm=(x, 4.0, z)))
    least_z, spinning = z, False
    for text in plan.blocks:
        step = interpreter.take(text.encode())
        spinning = spinning or interpreter.state.spindle == "M3"
        if not step.moves:
            continue
        assert spinning
        (x0, y0, z0), (x1, y1, z1) = step.start_mm, step.end_mm
        assert z0 is not None and z1 is not None
        if (x0, y0) != (x1, y1):
            assert z0 == z1 and z1 >= 5.0
        if z1 < z0 and z1 < 5.0:
            assert step.kind == "feed" and step.feed_mm_per_min is not None and step.feed_mm_per_min <= 300.0
        least_z = min(least_z, z1)
    assert interpreter.state.position_mm == plan.position_mm
    assert interpreter.state.coolant == "M8"
    assert interpreter.state.feed_mm_per_min == (200.0 if executed == 7 else 900.0)


def test_a_spindle_that_spins_up_has_its_dwell_before_anything_moves(raster: Shop) -> None:
    blocks = raster.plan(10).blocks
    assert blocks[1] == "M3 S12000" and blocks[2].startswith("G4 P") and blocks[3].startswith("G0 Z")


@pytest.mark.parametrize(("slowest", "down"), [(200, 200), (900, 300)])
def test_down_is_no_faster_than_a_plunge_nor_than_the_program_ever_goes(
    tmp_path: Path, slowest: int, down: int
) -> None:
    lines = ["G21 G90", "G0 Z5", "G0 X0 Y0", f"G1 Z-1 F{slowest}", "X1", "X2 F1200", "X3", "G0 Z5", "M2"]
    shop = Shop(tmp_path, lines)
    shop.facts = dataclasses.replace(shop.facts, feeds_mm_per_min=(slowest, 1200.0))
    assert f"G1 Z-1 F{down}" in shop.plan(6).blocks


def test_travel_is_as_high_as_the_program_itself_goes(tmp_path: Path) -> None:
    shop = Shop(tmp_path, ["G21 G90", "G0 Z22", "G0 X1 Y1", "G1 Z-1 F200", "X2", "X3", "G0 Z22", "M2"])
    assert "G0 Z22" in shop.plan(5).blocks


def test_a_tool_that_is_higher_stays_high_until_it_is_across(raster: Shop) -> None:
    status = dataclasses.replace(IDLE, work_mm=(0.0, 0.0, 40.0), machine_mm=(0.0, 0.0, 40.0))
    blocks = raster.plan(10, dataclasses.replace(NOW, status=status)).blocks
    across = next(i for i, block in enumerate(blocks) if block.startswith("G0 X"))
    assert blocks[across + 1] == "G0 Z5" and not any(block.startswith("G0 Z") for block in blocks[:across])


def test_arc_starts_again_from_its_start_with_its_mode(tmp_path: Path) -> None:
    lines = [
        "G21 G90",
        "G0 Z5",
        "G0 X0 Y0",
        "G1 Z-1 F200",
        "G2 X2 Y0 I1 J0 F300",
        "X4 Y0 I1 J0",
        "X6 Y0 I1 J0",
        "G0 Z5",
    ]
    shop = Shop(tmp_path, lines)
    plan = shop.plan(6)
    assert plan.position_mm == (2.0, 0.0, -1.0)
    assert next(text for number, text in shop.sent(plan) if number) == "G2X4Y0I1J0"


def test_inch_and_plane_come_back(tmp_path: Path) -> None:
    lines = ["G20 G90 G18", "G0 Z0.2", "G0 X0 Y0", "G1 Z-0.1 F20", "X1", "X2", "X3", "G0 Z0.2"]
    shop = Shop(tmp_path, lines)
    plan = shop.plan(6)
    assert plan.position_mm == pytest.approx((25.4, 0.0, -2.54))
    steps = dict(ends(shop.sent(plan), ModalState(position_mm=(0.0, 0.0, 5.0))))
    assert steps[6].end_mm[0] == pytest.approx(50.8) and steps[6].feed_mm_per_min == pytest.approx(508.0)


@pytest.mark.parametrize(
    ("lines", "executed", "words"),
    [
        (["G21 G90", "G0 X0 Y0 Z5", "G1 Z-1 F100", "G91", "X1", "X1", "X1"], 6, "G91"),
        (["G21 G90", "G0 X0 Y0 Z5", "G92 X5", "G0 X0 Y0 Z5", "G1 Z-1 F100", "X1", "X2"], 6, "G92"),
    ],
)
def test_what_cannot_be_rebuilt_is_refused(tmp_path: Path, lines: list[str], executed: int, words: str) -> None:
    plan = Shop(tmp_path, lines).plan(executed)
    assert not plan.ready and words in plan.refusals[0] and any("REFUSED" in one for one in plan.words)


def test_another_program_is_refused(raster: Shop) -> None:
    assert "sha256" in raster.plan(10, sha256="0" * 64).refusals[0]


def test_a_program_that_changed_on_disk_is_refused(raster: Shop) -> None:
    raster.path.write_text(raster.path.read_text().replace("X13Y10", "X14Y10"))
    assert "changed on disk" in raster.plan(10).refusals[0]


def test_a_tool_change_is_not_stepped_back_over(tmp_path: Path) -> None:
    lines = [
        "G21 G90",
        "G0 Z5",
        "G0 X0 Y0",
        "G1 Z-1 F200",
        "X1",
        "G0 Z5",
        "M5",
        "M0",
        "M3 S9000",
        "G0 X5",
        "G1 Z-2",
        "X9",
    ]
    shop = Shop(tmp_path, lines, every_lines=100)
    for executed in (8, 9):
        plan = shop.plan(executed)
        assert plan.overlap_line == 10 and plan.position_mm == (1.0, 0.0, 5.0) and "M3 S9000" in plan.blocks
    assert shop.plan(7).overlap_line == 6
    assert shop.plan(10).overlap_line == 10


class TestWhatMustBeDoneFirst:
    def needs(self, shop: Shop, present: Present, **record: Any) -> list[str]:
        return [need.code for need in shop.plan(10, present, **record).needs]

    def status(self, **changes: Any) -> Present:
        return dataclasses.replace(NOW, status=dataclasses.replace(IDLE, **changes))

    def test_nothing(self, raster: Shop) -> None:
        assert self.needs(raster, NOW) == []

    @pytest.mark.parametrize(
        ("state", "code"),
        [
            (MillState.DISCONNECTED, "connect"),
            (MillState.CONNECTING, "connect"),
            (MillState.ALARM, "unlock"),
            (MillState.HELD, "stand still"),
            (MillState.RUN, "wait"),
            (MillState.HOMING, "wait"),
            (MillState.DOOR, "stand still"),
        ],
    )
    def test_a_mill_that_is_not_idle(self, raster: Shop, state: MillState, code: str) -> None:
        assert self.needs(raster, self.status(state=state)) == [code]

    def test_a_position_that_nobody_vouches_for(self, raster: Shop) -> None:
        doubted = self.status(position_trusted=False)
        assert self.needs(raster, doubted) == []  # feed and spindle are set still: it never restarted
        reset = dataclasses.replace(doubted, parser_state="G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0")
        assert self.needs(raster, reset) == ["position"]
        assert self.needs(raster, dataclasses.replace(doubted, parser_state=None)) == ["position"]
        assert self.needs(raster, dataclasses.replace(doubted, restarted=True)) == ["position"]
        assert self.needs(raster, doubted, position_trusted=False) == ["position"]

    @pytest.mark.parametrize(
        ("left_mm", "now_mm", "known"),
        [
            ((3.0, 4.0, -1.2), (3.0, 4.0, -1.2), True),
            ((3.0, 4.0, -1.2), (3.0, 4.001, -1.2), True),  # another last digit
            ((3.0, 4.0, -1.2), (3.0, 4.0, -1.19), False),  # somebody has moved it
            ((3.0, 4.0, -1.2), (0.0, 0.0, 0.0), False),  # its power was off
            ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), False),  # it may have been
            ((3.0, 4.0, -1.2), None, False),
        ],
    )
    @pytest.mark.parametrize("name", ["machine_mm", "stood_mm"])
    def test_a_reset_from_standstill_keeps_the_position(
        self, raster: Shop, name: str, left_mm: Any, now_mm: Any, known: bool
    ) -> None:
        """On a new link, with feed and spindle wiped out: a mill that stands where it was left has kept its count."""
        reset = dataclasses.replace(
            self.status(position_trusted=False, machine_mm=now_mm),
            parser_state="G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0",
        )
        record = {"machine_mm": (9.0, 9.0, 9.0)} | {name: left_mm}
        assert self.needs(raster, reset, **record) == ([] if known else ["position"])
        assert self.needs(raster, dataclasses.replace(reset, restarted=True), **record) == ["position"]
        assert self.needs(raster, reset, **record | {"position_trusted": False}) == ["position"]
        assert self.needs(raster, reset, **record | {"reframed": True}) == ["position"]

    @pytest.mark.parametrize("number", sorted(FRAME_SETTINGS | {0, 10, 13, 20, 21, 110, 120}))
    @pytest.mark.parametrize("trusted", [True, False])
    def test_a_setting_that_moves_the_frame(self, raster: Shop, number: int, trusted: bool) -> None:
        """Even on a mill that was homed since: what is cut already was cut by the old one."""
        then = {str(one): "2.000" for one in range(200)}
        for value, changed in (("2", False), ("2.016", True)):
            now = ControllerSettings(values=dict.fromkeys(range(200), "2.000") | {number: value})
            status = dataclasses.replace(IDLE, position_trusted=trusted)
            present = Present.of_run({"settings": {"values": then}}, status, NOW.parser_state, now)
            plan = raster.plan(10, dataclasses.replace(present, offsets=OFFSETS, homed=trusted))
            moves = changed and number in FRAME_SETTINGS
            assert [need.code for need in plan.needs] == (["position"] if moves else [])
            assert not moves or f"${number} 2.000 -> 2.016" in plan.needs[0].words
            assert position_doubt({"position_trusted": True}, present) == ("settings" if moves else "")

    def test_settings_that_were_not_reported_say_nothing(self) -> None:
        then: dict[str, Any]
        for then, now in (({}, {100: "250.000"}), ({"100": "250.000"}, {})):
            present = Present.of_run({"settings": {"values": then}}, IDLE, None, ControllerSettings(values=now))
            assert present.frame_changes == ()
        assert Present.of_run({"settings": None}, IDLE, None, None).frame_changes == ()

    @pytest.mark.parametrize("name", ["G54", "G92", "TLO"])
    def test_an_offset_that_moves_the_program(self, raster: Shop, name: str) -> None:
        moved = dataclasses.replace(NOW, offsets=OFFSETS | {name: (0.0, 0.0, 0.5)})
        plan = raster.plan(10, moved)
        assert [need.code for need in plan.needs] == ["zero"]
        assert plan.differences == (f"{name} was X0.000 Y0.000 Z0.000, is X0.000 Y0.000 Z0.500",)
        assert raster.plan(10, dataclasses.replace(moved, vouched_axes="Z")).ready
        assert not raster.plan(10, dataclasses.replace(moved, vouched_axes="XY")).ready

    def test_an_offset_that_does_not_is_only_named(self, raster: Shop) -> None:
        plan = raster.plan(10, dataclasses.replace(NOW, offsets=OFFSETS | {"G55": (9.0, 2.0, 3.0)}))
        assert plan.ready and any("G55" in words for words in plan.words)

    def test_start_up_blocks_that_set_a_feed_do_not_hide_a_restart(self, raster: Shop) -> None:
        """$N0=G1 F900: after every restart $G says F900, as it did before the program was first started."""
        doubted = dataclasses.replace(self.status(position_trusted=False), parser_state="G1 G54 G21 G90 M5 M9 F900 S0")
        assert self.needs(raster, doubted, state_before="G0 G54 G21 G90 M5 M9 F0 S0") == []
        assert self.needs(raster, doubted, state_before="G1 G54 G21 G90 M5 M9 F900 S0") == ["position"]
        spinning = dataclasses.replace(doubted, parser_state="G1 G54 G21 G90 M3 M9 F900 S0")
        assert self.needs(raster, spinning, state_before="G1 G54 G21 G90 M5 M9 F900 S0") == []


def test_where_nothing_is_cut_no_line_0_is_named(raster: Shop) -> None:
    words = raster.plan(0).words
    assert "no line is cut for certain; line 1 is the next one" in words
    assert "lines up to 3 are cut for certain; line 4 is the next one" in raster.plan(3).words


OTHER_FACTS: dict[str, Any] = {
    "run_id": "other", "executed_line": 8, "overlap_line": 7, "position_mm": (1.0, 2.0, 3.5), "blocks": ("G0 Z9",),
    "needs": (Need(MillCode.WAIT, Phrase("wait")),), "refusals": (Phrase("no"),), "zero_back": "G10 L2 P1 X0",
    "motion": "G2", "spindle_on": None, "tool_mm": (3.0, 4.0, 9.0), "offsets": OFFSETS | {"G54": (0.0, 0.0, 0.1)},
}  # fmt: skip
ONLY_SHOWN: dict[str, Any] = {
    "words": (Phrase("said otherwise"),), "differences": (Phrase("said otherwise"),),
    "resume_line": 99,  # follows from executed_line
}  # fmt: skip


@pytest.mark.parametrize("name", [member.name for member in dataclasses.fields(RecoveryPlan)])
def test_one_plan_is_told_from_another_by_facts_and_not_by_words(raster: Shop, name: str) -> None:
    status = dataclasses.replace(IDLE, spindle_on=True)
    plan = raster.plan(10, dataclasses.replace(NOW, status=status))
    other = dataclasses.replace(plan, **{name: (OTHER_FACTS | ONLY_SHOWN)[name]})
    assert (other.digest == plan.digest) is (name in ONLY_SHOWN)


def test_the_height_is_that_in_the_frame_of_the_program(raster: Shop) -> None:
    """The controller is in G55, in which the tool seems high up: in G54 it is in the work, and goes up first."""
    status = dataclasses.replace(IDLE, machine_mm=(3.0, 4.0, -1.2), work_mm=(3.0, 4.0, 30.0))
    offsets = OFFSETS | {"G55": (0.0, 0.0, -31.2)}
    blocks = raster.plan(10, dataclasses.replace(NOW, status=status, offsets=offsets), offsets=offsets).blocks
    across = next(i for i, block in enumerate(blocks) if block.startswith("G0 X"))
    assert blocks[across - 1] == "G0 Z5"


def test_a_one_way_link_is_recovered_by_its_sequence_numbers(tmp_path: Path) -> None:
    lines = ["N10 G21 G90", "N20 G0 X0 Y0 Z5", *(f"N{10 * n} G1 X{n} F100" for n in range(3, 60)), "G0 Z5", "M2"]
    shop = Shop(tmp_path, lines)
    shop.facts = dataclasses.replace(shop.facts, dialect="okuma-osp")
    plan = shop.plan(12, sent_line=40)
    refusal = " ".join(plan.refusals)
    assert not plan.ready and plan.needs == () and plan.blocks == ()
    assert "line 40 (N400)" in refusal and "line 12 (N120)" in refusal and "sequence number" in refusal


def test_what_leaves_the_travel_is_a_refusal_only_where_nothing_has_to_be_done_first(raster: Shop) -> None:
    """An untrusted position is no ground for one; and a part that is half cut keeps its work zero."""
    problem = ("Z would go from -10.187 to 0.272 mm",)
    lost = dataclasses.replace(NOW, restarted=True, status=dataclasses.replace(IDLE, position_trusted=False))
    plan = raster.plan(10, lost).with_place(problem, refused=True)
    assert plan.refusals == () and [need.code for need in plan.needs] == ["position"]
    assert any("not certain" in words and "0.272" in words for words in plan.words)
    (refusal,) = raster.plan(10).with_place(problem, refused=True).refusals
    assert "home the mill" in refusal and "Do not move the work zero" in refusal


@pytest.mark.parametrize(("top_mm", "travel_z"), [(None, "5"), (9.0, "5"), (3.25, "3.25")])
def test_the_way_in_is_as_high_as_the_mill_gets(tmp_path: Path, top_mm: float | None, travel_z: str) -> None:
    shop = Shop(tmp_path, ["G21 G90", "G0 Z2", "G0 X1 Y1", "G1 Z-1 F200", "X2", "X3", "G0 Z2", "M2"])
    assert f"G0 Z{travel_z}" in shop.plan(5, dataclasses.replace(NOW, top_mm=top_mm)).blocks
    assert "G0 Z2" in shop.plan(5, dataclasses.replace(NOW, top_mm=1.0)).blocks  # refused by whoever checks the travel


@pytest.mark.parametrize("then", [False, True])
@pytest.mark.parametrize("now", [False, True])
@pytest.mark.parametrize("sure", [False, True])
def test_the_old_zero_is_put_back_only_where_machine_coordinates_are_the_same(
    raster: Shop, then: bool, now: bool, sure: bool
) -> None:
    """Homed then and homed now; the block that is offered makes the offsets equal, and the plan ready."""
    moved = OFFSETS | {"G54": (-150.25, -100.0, -20.0)}
    record = {"homed": then, "offsets": OFFSETS | {"G54": (-150.0, -100.0, -21.5)}}
    status = dataclasses.replace(IDLE, position_trusted=sure)
    present = dataclasses.replace(NOW, status=status, offsets=moved, homed=now)
    plan = raster.plan(9, present, **record)
    assert "zero" in [need.code for need in plan.needs]
    assert plan.zero_back == ("G10 L2 P1 X-150.000 Y-100.000 Z-21.500" if then and now and sure else "")
    same = raster.plan(9, dataclasses.replace(present, offsets=record["offsets"]), **record)
    assert same.zero_back == "" and "zero" not in [need.code for need in same.needs]
