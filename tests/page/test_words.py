"""What a person beside a mill reads: no names for parts of the service, which nobody there sees."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from tests.page.answers import problem
from tests.page.browser import NOWHERE, open_blank
from tests.page.conftest import Opened
from tests.page.machine_states import MACHINE, told, with_control
from tests.page.machine_states import NAME as MILL

ROOT = Path(__file__).parents[2]
# What these say in a refusal or of a run is shown on the page; what is said while a server starts is not.
SPEAKERS = (
    *("agent_feed", "agent_client", "agent_replies", "run_commands", "core", "machine_events", "machine_commands"),
)
JARGON = re.compile(r"\b(agent|token|thread|trust position|SendBlock)\b")
SENTENCES = "async (said) => { const words = await import('/page/machine/words.js'); return said.map(words.sentence); }"


def spoken(path: Path, words: re.Pattern[str] = JARGON) -> Iterator[str]:
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


def test_what_parts_of_the_service_say_of_each_other_is_plain_on_the_page(modules: Page) -> None:
    paths = [ROOT / "service/server/fleet" / f"{name}.py" for name in SPEAKERS]
    paths += [ROOT / "service/milling/agent/mill_access.py", *sorted((ROOT / "machines/mill").glob("*.py"))]
    said = [text for path in paths for text in spoken(path) if "owns this mill" not in text]
    assert len(said) > 15, said
    shown = modules.evaluate(SENTENCES, said)
    assert not [pair for pair in zip(said, shown, strict=True) if JARGON.search(pair[1])]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("remote", "then"),
    [(False, "To connect it again, start the server again."), (True, "Switch it on, or start causticmill mill on it.")],
)
def test_a_mill_out_of_reach_says_what_brings_it_back(opened: Opened, remote: bool, then: str) -> None:
    page = opened(NOWHERE)
    told(page, "no-agent")
    agent = {"reachable": False, "words": f"machine '{MILL}' has no agent at present; `serve` starts one"}
    machine: dict[str, Any] = MACHINE | {"remote": remote, "agent": agent, "mill": None}
    page.route("**/v1/machines", lambda route: route.fulfill(json={"machines": [machine], "problems": []}))
    page.evaluate("location.hash = '#/machines'")
    expect(page.get_by_role("listitem")).to_contain_text(f"The computer beside the mill does not answer. {then}")


def test_a_refused_order_is_told_in_plain_words(opened: Opened) -> None:
    page = open_blank(opened, "machine", errors=("status of 504",))
    told(page, "running")
    page.evaluate(f"location.hash = '#/machines/{MILL}'")
    page.route(
        "**/control/hold",
        lambda route: route.fulfill(**problem(504, detail=f"the agent of '{MILL}' did not answer within 3 s")),
    )
    page.get_by_role("button", name="HOLD").click()
    expect(page.locator(".arrived")).to_have_text(
        "HOLD did not arrive. Use the stop button on the mill itself. "
        "(The computer beside the mill did not answer within 3 s.)"
    )


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("rest", "brief"),
    [
        ("it is asked for again in some seconds", "The computer beside the mill does not answer."),
        ("whether the home arrived is not known: LOOK AT THE MILL", "Look at the mill: the order may have arrived."),
    ],
)
def test_a_long_refusal_of_the_next_step_is_brief_in_the_line_and_whole_in_its_fold(
    opened: Opened, rest: str, brief: str
) -> None:
    page = with_control(opened, "locked", size="phone", errors=("status of 504",))
    words = f"the agent of '{MILL}' cannot be reached: no answer in time; {rest}"
    page.route("**/control/home", lambda route: route.fulfill(**problem(504, detail=words)))
    line = page.locator(".next")
    line.get_by_role("button", name="Home").click()
    expect(line.locator(".trouble")).to_have_text(brief)
    assert line.locator(".next-words").evaluate("one => one.offsetHeight <= one.closest('.next').offsetHeight")
    line.get_by_text("More").click()
    expect(line.locator(".next-more")).to_have_text(f"The computer beside the mill does not answer; {rest}.")


def test_a_slope_is_told_in_what_one_can_measure_beside_its_unit() -> None:
    said = [text for path in (ROOT / "service").rglob("*.py") for text in spoken(path, re.compile(r"\bmrad\b"))]
    assert len(said) >= 3, said
    assert not [text for text in said if "µm per mm (" not in text]
