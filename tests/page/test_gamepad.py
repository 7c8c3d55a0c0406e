"""A gamepad jogs like keys that are held: only once armed, one direction at a time, and never on after a change."""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from tests.page.conftest import Opened
from tests.page.machine_states import with_control
from tests.page.test_next_step import after, orders_of

PAD = """
    Object.defineProperty(navigator, "getGamepads", { configurable: true, value: () => [null, window.down && {
        connected: true, buttons: Array.from({ length: 17 }, (_, place) => ({ pressed: window.down.includes(place) })),
    }] });
"""
PRESS = """async (place) => {
    for (const down of [[], [place], []]) {
        window.down = down;
        await new Promise((seen) => setTimeout(seen, 100));
    }
}"""
WATCH = """async (looks) => {
    const { watchGamepad } = await import("/page/machine/gamepad.js");
    const [calls, frame] = [[], window.requestAnimationFrame];
    let next = null;
    window.requestAnimationFrame = (look) => ((next = look), 1);
    const pad = watchGamepad({ begin: (way) => calls.push(way.join(" ")), end: () => calls.push("end") });
    window.down = looks[0];
    pad.on();
    for (const down of looks.slice(1)) { window.down = down; next(); }
    window.requestAnimationFrame = frame;
    return calls;
}"""
UP, LEFT, RIGHT, RAISE, OTHER = 12, 14, 15, 5, 0
CASES = (
    ([[], [RIGHT], [RIGHT], []], ["1 0 0", "end"]),
    ([[], [RAISE], None], ["0 0 1", "end"]),  # the pad is gone
    ([[RIGHT], [RIGHT], [], [UP], []], ["end", "0 1 0", "end"]),  # it was down before
    ([[], [RIGHT], [UP, RIGHT], [UP], []], ["1 0 0", "end", "end", "end"]),
    ([[], [LEFT, RIGHT], [LEFT], []], ["end", "end"]),
    ([[], [OTHER], []], []),
)


def test_one_button_begins_and_any_change_ends(modules: Page) -> None:
    modules.evaluate(PAD)
    assert [modules.evaluate(WATCH, looks) for looks, _ in CASES] == [calls for _, calls in CASES]
    modules.evaluate("delete navigator.getGamepads")


@pytest.mark.thorough
def test_it_moves_the_mill_only_while_the_pad_is_armed(opened: Opened) -> None:
    page = with_control(opened, "idle")
    page.evaluate(f"() => {{ window.down = []; {PAD} }}")
    sent = orders_of(page)
    page.evaluate(PRESS, RIGHT)
    page.get_by_role("button", name="Use keyboard or gamepad").click()
    assert sent == []
    page.evaluate(PRESS, RIGHT)
    after(sent, 1, page)
    assert sent[0][0] == "jog" and sent[0][1]["by_mm"] == [1, 0, 0]
    page.get_by_role("link", name="Jobs", exact=True).focus()
    expect(page.get_by_role("button", name="Use keyboard or gamepad")).to_be_visible()
    page.evaluate(PRESS, RIGHT)
    after(sent, 1, page)
