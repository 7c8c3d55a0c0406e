"""The one mill API: an order is validated once, by the agent, and nothing in it is guessed."""

from __future__ import annotations

import json
from typing import Annotated, Any
from unittest.mock import Mock, call

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from machines.driver import Home, Jog, Override, ProbeCorner, ProbeZ, SendBlock, SetZero
from machines.runs import RunReport, RunState
from service.http.problems import Problem
from service.http.schema import PassedOn
from service.milling.api import ORDERS, PLAIN_ORDERS, GrantBody, OverrideBody, RunReply

CORNER = {
    "depth_mm": 20.0, "plate_mm": 10.0, "wall_x_mm": 6.0, "wall_y_mm": 6.0, "cutter_radius_mm": 1.5, "margin_mm": 8.0,
}  # fmt: skip
GOOD: dict[str, dict[str, Any]] = {
    "jog": {"by_mm": [1.0, 0.0, -2.5]},
    "go-to-zero": {"axes": "XYZ", "feed_mm_per_min": 800.0},
    "frame": {"program": "ab" * 32},
    "probe": {"depth_mm": 5.0},
    "probe-corner": CORNER,
    "zero": {},
    "override": {"what": "feed", "percent": 90},
    "spindle": {"on": True, "rpm": 9000.0},
    "check": {"on": True},
    "block": {"text": "G0 X1"},
}
ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(exclude_categories=())),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(what=st.sampled_from(sorted(ORDERS)), body=st.one_of(ANY_JSON, st.fixed_dictionaries({"by_mm": ANY_JSON})))
def test_what_passes_an_order_on_looks_at_nothing_but_that_it_can_be_sent(what: str, body: Any) -> None:
    """A server in between changes nothing; what it cannot send as JSON it refuses in the agent's own words."""
    form = ORDERS[what]
    try:
        sent = json.dumps(body, allow_nan=False, ensure_ascii=False).encode()
    except ValueError:
        sent = b""
    try:
        passed = TypeAdapter(Annotated[dict[str, Any], PassedOn(form)]).validate_python(body)
    except ValidationError as refused:
        assert not (sent and isinstance(body, dict))
        with pytest.raises(ValidationError) as of_agent:
            form.model_validate(body)
        assert [one["msg"] for one in refused.errors()] == [one["msg"] for one in of_agent.value.errors()]
    else:
        assert passed == body and isinstance(passed, dict)


@pytest.mark.parametrize("what", sorted(GOOD))
@pytest.mark.parametrize("guess", [lambda number: str(number), lambda number: bool(number), lambda number: None])
def test_a_number_or_flag_is_never_guessed(what: str, guess: Any) -> None:
    for name, value in GOOD[what].items():
        for wrong in [[guess(one), *value[1:]] for one in value[:1]] if isinstance(value, list) else [guess(value)]:
            if type(wrong) is not type(value) or isinstance(value, list):
                with pytest.raises(ValidationError):
                    ORDERS[what].model_validate(GOOD[what] | {name: wrong})


@pytest.mark.parametrize("stops", ["7", 7.5, True, -1])
def test_a_stop_count_is_never_guessed(stops: object) -> None:
    with pytest.raises(ValidationError):
        GrantBody.model_validate({"stops": stops})


def test_orders_become_what_the_mill_takes() -> None:
    assert set(GOOD) == set(ORDERS) and not set(ORDERS) & set(PLAIN_ORDERS)
    calls = {"go-to-zero": call.go_to_zero("XYZ", 800.0), "frame": call.frame("ab" * 32, 1000.0)}
    calls["spindle"] = call.switch_spindle(9000.0)
    for what, expected in calls.items():
        ORDERS[what].model_validate(GOOD[what]).make_act()(mill := Mock())
        assert mill.mock_calls == [expected]
    made = {what: ORDERS[what].model_validate(body).command() for what, body in GOOD.items() if what not in calls}
    assert made["jog"] == Jog((1.0, 0.0, -2.5), 500.0)
    assert made["probe"] == ProbeZ(5.0, 50.0, 0.0, 2.0)
    assert made["probe-corner"] == ProbeCorner(**CORNER, feed_mm_per_min=100.0, aside_mm=20, below_mm=5, retract_mm=5)
    assert (made["zero"], made["override"]) == (SetZero("XYZ"), Override("feed", 90))
    assert (made["block"], PLAIN_ORDERS["home"]()) == (SendBlock("G0 X1"), Home())
    ORDERS["spindle"].model_validate({"on": False}).make_act()(mill := Mock())
    assert mill.mock_calls == [call.switch_spindle(None)]
    for half in ({"on": True}, {"on": False, "rpm": 9000.0}):
        with pytest.raises(Problem, match="rpm must be above 0"):
            ORDERS["spindle"].model_validate(half).make_act()
    with pytest.raises(Problem, match="percent is 30; allowed: 25, 50, 100"):
        OverrideBody(what="rapid", percent=30).command()


@pytest.mark.parametrize("state", RunState)
def test_what_an_agent_says_of_a_run_is_what_its_readers_take(state: RunState) -> None:
    run = RunReport(
        id="20261129-1", name="a", program="0" * 64, path="/p", state=state, lines=10, executed_line=4, time_s=5.0,
        created_s=1.0, warnings=("w",), values={"a": 1},
    )  # fmt: skip
    said = json.loads(json.dumps(run.as_dict()))
    report = RunReply.model_validate(said, extra="ignore")
    assert {name: said[name] for name in RunReply.model_fields} == report.model_dump(mode="json")
