"""Steps of the jog that add up, against a model of the mill: each press is carried out, or dropped and named, and
nothing that was pressed before a stop moves the mill after it."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from playwright.sync_api import Page

MOST_WAITING_MM = 20

# A mill that takes an order only when it stands, and only as of its own count of stops; between it and the page every
# message is delivered by an event of its own: an order, its answer, an entry of the log, a status.
MODEL = """async (events) => {
    const { WaitingSteps } = await import("/page/machine/waiting_steps.js");
    let clock = 1e6;
    const real = [performance.now, Date.now];
    performance.now = Date.now = () => clock;
    const turn = async () => { for (let k = 0; k < 4; k += 1) await null; };
    const mill = { at: [0, 0, 0], stops: 0, jog: null, log: [] };
    const add = (a, b) => a.map((mm, k) => mm + b[k]);
    const facts = () => {
        const { at, jog, stops } = mill;
        return { connected: true, state: jog ? "jog" : "idle", stops, machine_mm: at, work_mm: at };
    };
    const link = {
        commands: 0, lastAnswer: null, pressedStops: 0, away: "", mine: true, sending: false, unanswered: -1, secret: 1,
        machine: { agent: { reachable: true }, mill: facts() },
        get busy() { return this.sending || this.unanswered === this.commands; },
        givenNow() {
            const { machine, pressedStops, secret } = this;
            return { stops: machine.mill.stops, pressed: pressedStops, headers: { secret } };
        },
    };
    const none = [0, 0, 0];
    const told = { pressed: none, refused: none, taken: none, moved: none, dropped: [], orders: [], longest: 0 };
    Object.assign(told, { afterStop: none, pressedAfterStop: none });
    const rest = Array(16).fill(["order", "answer", "done", "log", "status"].map((what) => [what])).flat();
    const wire = []; // orders that have not reached the mill, then answers that have not reached the page
    const answers = [];
    const send = (by_mm, feed, given) => new Promise((answer) => {
        link.sending = true;
        told.orders.push(by_mm);
        wire.push({ by_mm, given, before: link.commands, answer });
    });
    const steps = new WaitingSteps(link, { send, changed: () => {} });
    const drop = steps.drop.bind(steps);
    steps.drop = () => { told.dropped.push(...steps.waiting.map((one) => one.by_mm)); drop(); };
    const move = (share) => {
        const { by_mm, from } = mill.jog;
        const moved = by_mm.map((mm) => mm * share);
        mill.at = add(from, moved);
        told.moved = add(told.moved, moved);
        told.afterStop = add(told.afterStop, moved);
        mill.log.push({ moved_mm: moved, at_machine_mm: mill.at });
        mill.jog = null;
    };
    const stop = () => {
        if (mill.jog) move(0.5);
        mill.stops += 1;
        Object.assign(told, { afterStop: none, pressedAfterStop: none });
    };
    const act = {
        async press(by_mm) {
            try {
                await Promise.race([steps.press(by_mm, 500), turn()]);
                told.pressed = add(told.pressed, by_mm);
                told.pressedAfterStop = add(told.pressedAfterStop, by_mm);
            } catch { /* said: it does not wait */ }
        },
        order() {
            const order = wire.shift();
            if (!order) return;
            const taken = !mill.jog && order.given.stops === mill.stops;
            if (taken) {
                mill.jog = { by_mm: order.by_mm, from: mill.at };
                told.taken = add(told.taken, order.by_mm);
            } else told.refused = add(told.refused, order.by_mm);
            answers.push({ order, taken });
        },
        refuse() {
            const order = wire.shift();
            if (!order) return;
            told.refused = add(told.refused, order.by_mm);
            answers.push({ order, taken: false });
        },
        answer() {
            const found = answers.shift();
            if (!found) return;
            if (found.taken) link.unanswered = found.order.before;
            link.sending = false;
            found.order.answer(found.taken);
        },
        done() { if (mill.jog) move(1); },
        short() { if (mill.jog) move(0.5); }, // by a fault, without a stop
        log() {
            const entry = mill.log.shift();
            if (entry) { link.commands += 1; link.lastAnswer = entry; }
        },
        status() { link.machine = { ...link.machine, mill: facts() }; },
        late() { link.unanswered = -1; },
        hold() { link.pressedStops += 1; stop(); },
        stopped() { stop(); },
        release() { link.secret += 1; },
        wait(ms) { clock += ms; },
    };
    try {
        for (const [what, value] of [...events, ...rest]) {
            await act[what](value);
            await turn();
            steps.update();
            await turn();
            told.longest = Math.max(told.longest, steps.length);
        }
    } finally {
        [performance.now, Date.now] = real;
    }
    return { ...told, at: mill.at, waiting: steps.words, said: steps.dropped };
}"""
PLUS_X, PLUS_Y = (1, 0, 0), (0, 1, 0)


def press(direction: tuple[int, int, int], mm: float) -> tuple[str, list[float]]:
    return "press", [mm * one for one in direction]


PRESSES = st.builds(press, st.sampled_from([PLUS_X, PLUS_Y]), st.sampled_from([0.1, 1.0, 10.0]))
WAYS = st.sampled_from([(what, None) for what in ("order", "answer", "done", "log", "status")])
CAUSES = ("refuse", "short", "late", "hold", "stopped", "release")
TROUBLE = st.sampled_from([*((what, None) for what in CAUSES), ("wait", 900), ("wait", 6000)])


def add(*rows: list[float]) -> list[float]:
    return [sum(column) for column in zip(*rows, strict=True)] if rows else [0, 0, 0]


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(st.one_of(PRESSES, PRESSES, WAYS, WAYS, WAYS, TROUBLE), max_size=30))
def test_each_press_is_carried_out_or_dropped_and_no_stop_is_outlived(modules: Page, events: list[Any]) -> None:
    found = modules.evaluate(MODEL, events)
    assert found["waiting"] == ""
    accounted = add(found["taken"], found["refused"], add(*found["dropped"]) if found["dropped"] else [0, 0, 0])
    assert accounted == pytest.approx(found["pressed"]), "a press is lost, or carried out twice"
    assert found["longest"] <= MOST_WAITING_MM + 1e-6
    for moved, pressed in zip(found["afterStop"], found["pressedAfterStop"], strict=True):
        assert moved <= pressed + 1e-6, "what was pressed before a stop moved the mill after it"
    assert found["at"] == pytest.approx(found["moved"])


def test_six_quick_presses_of_1_mm_are_6_mm(modules: Page) -> None:
    found = modules.evaluate(MODEL, [press(PLUS_X, 1.0)] * 6)
    assert found["at"] == pytest.approx([6, 0, 0])
    assert found["orders"] == [[1, 0, 0], [5, 0, 0]]


def test_steps_of_two_axes_are_no_diagonal(modules: Page) -> None:
    found = modules.evaluate(MODEL, [press(way, 1.0) for way in (PLUS_X, PLUS_Y, PLUS_X, PLUS_X, PLUS_Y)])
    assert found["orders"] == [[1, 0, 0], [0, 1, 0], [2, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("trouble", ["hold", "stopped", "release", "refuse", "short"])
def test_what_waits_is_dropped_by_anything_but_an_ended_step_and_named(modules: Page, trouble: str) -> None:
    taken = [] if trouble == "refuse" else [("order", None), ("answer", None)]
    found = modules.evaluate(MODEL, [*[press(PLUS_X, 1.0)] * 3, *taken, (trouble, None)])
    assert len(found["orders"]) == 1
    assert found["said"] == "Not carried out: X +2 mm."
