"""What a person beside a mill reads: no names for parts of the service, which nobody there sees."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from machines.driver import FaultCause, MillState
from machines.errors import MillCode
from machines.grbl.replies import ALARMS
from machines.mill.orders import Refusal, Stop
from machines.recovery.needs import DOUBTS
from machines.runs import RunState
from service.http.problems import ServerCode
from service.job.stages.table import _ROWS as stages
from tests.page.answers import problem
from tests.page.browser import NOWHERE, open_blank
from tests.page.conftest import Opened
from tests.page.machine_states import ABSENT, MACHINE, told, with_control
from tests.page.machine_states import NAME as MILL

ROOT = Path(__file__).parents[2]
JARGON = re.compile(r"\b(agent|token|thread|trust position|SendBlock)\b")
CODES = (*MillCode, *ServerCode, *Refusal, *Stop, *(cause.value for cause in FaultCause))
STATES = (*(state.value for state in RunState), *(state.value for state in MillState))
# Every value that a code comes with.
VALUES: dict[str, Any] = {
    "alarm": 1, "detail": "so it says", "doubt": "unseen", "effect": "it moves", "name": "p.nc", "operator": "Ada",
    "order": "home", "reason": "so it is", "seconds": 3, "state": "held", "status": 500, "taken_back": True,
    "text": "G0", "code": "", "values": {}, "words": "so it was",
}  # fmt: skip
TABLE = "async () => (await import('/page/machine/sentences.js')).CODES"
TOLD = """async (all) => {
    const { describe } = await import("/page/machine/sentences.js");
    return all.map(describe).flatMap(({brief, whole}) => [brief, whole]);
}"""


def test_every_stage_of_a_job_has_words(modules: Page) -> None:
    script = "async (names) => names.map((await import('/page/job/figures.js')).stageWords)"
    assert set(modules.evaluate(script, list(stages))).isdisjoint(stages)


def spoken(path: Path, words: re.Pattern[str]) -> Iterator[str]:
    """Every text of a module with one of these words in it, its values filled in; no docstrings, no names."""
    source = path.read_text()
    if not words.search(source):
        return
    tree = ast.parse(source)
    parts = {id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    parts |= {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if id(node) in parts or not isinstance(node, ast.Constant | ast.JoinedStr):
            continue
        pieces = node.values if isinstance(node, ast.JoinedStr) else [node]
        text = "".join(str(one.value) if isinstance(one, ast.Constant) else "shop" for one in pieces)
        if words.search(text) and text.count(" ") > 1:
            yield text


def test_every_code_has_a_sentence_on_the_page_and_no_other_has(modules: Page) -> None:
    assert len(set(CODES)) == len(CODES)
    assert sorted(modules.evaluate(TABLE)) == sorted(CODES)


def test_what_a_code_is_told_by_is_whole_and_plain(modules: Page) -> None:
    """Whatever state, alarm or doubt it is of; without names for parts of the service, which nobody at a mill sees."""
    ways = [VALUES | {"state": state} for state in STATES]
    ways += [VALUES | {"alarm": number} for number in (0, *ALARMS, 99)]
    ways += [VALUES | {"doubt": doubt} for doubt in DOUBTS] + [VALUES | {"seconds": 0, "taken_back": False}]
    ways += [VALUES | {"doubt": "settings", "settings": "$100 250.000 -> 252.000"}]
    told = modules.evaluate(TOLD, [{"code": code, "values": values} for code in CODES for values in ways])
    assert not [words for words in told if not words.strip() or re.search("undefined|null|NaN|object", words)]
    assert not [words for words in told if JARGON.search(words)]


def test_each_alarm_has_words_of_its_own(modules: Page) -> None:
    told = modules.evaluate(TOLD, [{"code": "locked", "values": {"alarm": number}} for number in ALARMS])
    assert not [words for words in told if re.search(r"is locked|larm \d", words)]


def test_what_comes_without_a_code_is_shown_as_it_was_stored(modules: Page) -> None:
    rows = [{"words": "the mill was switched off"}, {"code": "of_tomorrow", "values": {}, "words": "X is 3"}, {}]
    assert modules.evaluate(TOLD, rows)[1::2] == ["The mill was switched off.", "X is 3.", ""]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("remote", "then"),
    [(False, "To connect it again, start the server again."), (True, "Switch it on, or start causticmill mill on it.")],
)
def test_a_mill_out_of_reach_says_what_brings_it_back(opened: Opened, remote: bool, then: str) -> None:
    page = opened(NOWHERE)
    told(page, "no-agent")
    machine: dict[str, Any] = MACHINE | {"remote": remote, "agent": ABSENT, "mill": None}
    page.route(
        "**/v1/machines",
        lambda route: route.fulfill(json={"machines": [machine, MACHINE | {"name": "attic"}], "problems": []}),
    )
    page.evaluate("location.hash = '#/machines'")
    expect(page.get_by_role("listitem").first).to_contain_text(f"The computer beside the mill does not answer. {then}")


def test_a_refused_order_is_told_in_plain_words(opened: Opened) -> None:
    page = open_blank(opened, "machine", errors=("status of 504",))
    told(page, "running")
    page.evaluate(f"location.hash = '#/machines/{MILL}'")
    late = problem(504, detail="the agent is late", code="stop_uncertain", values={"order": "hold", "seconds": 3})
    page.route("**/control/hold", lambda route: route.fulfill(**late))
    page.get_by_role("button", name="HOLD").click()
    expect(page.locator(".stops .arrived")).to_have_text(
        "HOLD did not arrive. Use the stop button on the mill itself. "
        "(The computer beside the mill did not answer within 3 s.)"
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("code", "brief", "rest"),
    [
        (
            "order_without_effect",
            "The computer beside the mill does not answer.",
            "the home has not taken effect so far. The state of the program: held.",
        ),
        (
            "order_uncertain",
            "Look at the mill: the order may have arrived.",
            "whether the home arrived is not known: LOOK AT THE MILL, it is not sent again.",
        ),
    ],
)
def test_a_long_refusal_of_the_next_step_is_brief_in_the_line_and_whole_in_its_fold(
    opened: Opened, code: str, brief: str, rest: str
) -> None:
    page = with_control(opened, "locked", size="phone", errors=("status of 504",))
    refused = problem(504, detail="the agent cannot be reached", code=code, values={"order": "home", "state": "held"})
    page.route("**/control/home", lambda route: route.fulfill(**refused))
    line = page.locator(".next")
    line.get_by_role("button", name="Home").click()
    expect(line.locator(".trouble")).to_have_text(brief)
    assert line.locator(".next-words").evaluate("one => one.offsetHeight <= one.closest('.next').offsetHeight")
    line.get_by_text("More").click()
    expect(line.locator(".next-more")).to_have_text(f"The computer beside the mill does not answer; {rest}")


@pytest.mark.thorough
def test_a_program_that_may_not_fit_the_travel_is_said_before_its_start(opened: Opened) -> None:
    page = open_blank(opened, "machine")
    told(page, "parked")
    page.evaluate(f"location.hash = '#/machines/{MILL}'")
    expect(page.locator(".warned.warn summary")).to_have_text("It may not fit the travel")
    expect(page.locator(".warned.warn li").first).to_be_visible()


def test_a_slope_is_told_in_what_one_can_measure_beside_its_unit() -> None:
    said = [text for path in (ROOT / "service").rglob("*.py") for text in spoken(path, re.compile(r"\bmrad\b"))]
    assert len(said) >= 3, said
    assert not [text for text in said if "µm per mm (" not in text]
