"""Every key of the spec is listed with what it may be, and a wrong value of any gets a sentence, never a traceback."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.cli.plan import PlanRequest, _resolve_plan_job
from service.errors import SpecError
from service.job.spec.errors import describe_allowed, inner_schema, known_entries
from service.job.spec.keys import list_keys, make_page
from service.job.spec.loading import default_layer, override_machine, resolve_job

PAGE = Path(__file__).parents[4] / "docs" / "keys.md"
ROWS = list_keys()


def test_every_leaf_of_the_model_is_listed_once() -> None:
    keys = [row.key for row in ROWS]
    assert len(keys) == len(set(keys)) > 100
    for place in ((), ("image",), ("optics",), ("optics", "light"), ("stock",), ("finish",), ("machine",), ("plan",)):
        for name, entry in known_entries(place).items():
            if not inner_schema(entry).get("properties"):
                assert any(key.startswith(".".join((*place, name))) for key in keys), name
    assert all(row.allowed and row.default and row.meaning for row in ROWS)


@pytest.mark.parametrize("key", [row.key for row in ROWS])
@pytest.mark.parametrize("value", ["No Such!", "-1e9", "[true]", "{ a = 1 }"])
def test_a_wrong_value_gets_a_sentence_that_names_key_and_remedy(key: str, value: str) -> None:
    at = key.replace(".N", ".0")
    start = ["stock.clamps=[{x_mm=1, y_mm=1, height_mm=3}]", "stock.face={}", "stock.cut_out={}"]
    try:
        resolve_job(overrides=[*(one for one in start if at.startswith(one.partition("=")[0])), f"{at}={value}"])
    except SpecError as error:
        assert at.rpartition(".")[2] in str(error) or at.partition(".")[0] in str(error)
    else:
        assert value in ("No Such!", "-1e9"), (at, value)  # a name or a number that this key takes
    assert str(describe_allowed(tuple(int(step) if step.isdigit() else step for step in at.split("."))))


@pytest.mark.parametrize(
    ("given", "key"),
    [("machine=grbl-3018", "machine.profile"), ("finish=felt", "finish.process"), ("optics.light=sun", "light.kind")],
)
def test_a_word_for_a_table_is_answered_with_the_key_that_is_meant(given: str, key: str) -> None:
    with pytest.raises(SpecError, match=f"did you mean .*{key}={given.partition('=')[2]}"):
        resolve_job(overrides=[given])


@pytest.mark.parametrize("overrides", [(), ("finish.process=felt",), ("finish.process=none",), ("optics.width_mm=50",)])
def test_plan_and_make_plan_for_the_same_mill_and_finish(overrides: tuple[str, ...]) -> None:
    machine = "grbl-3018"
    request = PlanRequest(
        source=Path("p.png"), machine=machine, goal={}, tools=None, output=None, spec=None, overrides=overrides
    )
    layer = default_layer(file=None, preset=None, overrides=overrides)
    planned = _resolve_plan_job(request, layer).spec
    made = resolve_job(base=layer, overrides=[*override_machine(machine), *overrides]).spec
    assert planned == made and made.machine.profile == machine


def test_the_page_of_the_documents_is_that_of_the_model() -> None:
    """Set CAUSTICMILL_REWRITE_GOLDEN=1 to write it anew."""
    if os.environ.get("CAUSTICMILL_REWRITE_GOLDEN"):
        PAGE.write_text(make_page(), encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == make_page()
