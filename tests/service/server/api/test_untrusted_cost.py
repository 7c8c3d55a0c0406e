"""What a stranger sends costs at most in proportion to its length: eight times as much takes about eight times as long.

Counted are lines of Python that are run, not seconds.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from service.errors import SpecError
from service.http.problems import Problem
from service.job.spec.errors import MOST_PROBLEMS
from service.job.spec.loading import reduce_spec, resolve_spec
from service.server.api.intake.form import JobForm
from service.server.api.intake.request import job_request
from tests.service.server.api.server import ApiServer, problem

MORE = 8
SLACK = 1.6  # over proportional: a list that grows, a hash that collides


def lines_run(action: Callable[[], object]) -> int:
    """How many lines of Python an action runs, comprehensions item by item."""
    count = 0

    def note(_frame: FrameType, event: str, _argument: object) -> Callable[..., Any]:
        nonlocal count
        count += event == "line" or event == "call"
        return note

    before = sys.gettrace()
    sys.settrace(note)
    try:
        action()
    except (Problem, SpecError):
        pass
    finally:
        sys.settrace(before)
    return count


def read_spec(text: str) -> None:
    job_request(JobForm(path=Path("unused"), texts={"spec": bytearray(text.encode())}))


def items(text: str, count: int) -> str:
    return ",".join([text] * count)


def keys(count: int) -> str:
    return ",".join(f'"key{number}":1' for number in range(count))


TEXTS: dict[str, Callable[[int], str]] = {
    "a key twice, the last one": lambda n: f'{{{keys(n)},"key{n - 1}":1}}',
    "unknown keys": lambda n: f"{{{keys(n)}}}",
    "keys that nearly are some": lambda n: f'{{"optics":{{{keys(n).replace("key", "width_m")}}}}}',
    "a long key": lambda n: '{"optics":{"%s":1}}' % ("width_mm" * n),
    "passes that are none": lambda n: f'{{"passes":[{items("{}", n)}]}}',
    "rows that are none": lambda n: f'{{"optics":{{"light":{{"profile":[{items("[]", n)}]}}}}}}',
    "a long word": lambda n: '{"machine":{"profile":"%s"}}' % ("ab" * n),
    "a long number": lambda n: '{"optics":{"width_mm":0.%s}}' % ("1" * n),
    "lists for numbers": lambda n: f'{{"machine":{{"travel_mm":[{items("[1]", n)}]}}}}',
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_spec_costs_in_proportion_to_its_length(kind: str) -> None:
    few, many = (TEXTS[kind](count) for count in (1000, MORE * 1000))
    read_spec("{}")  # what is cached is there
    assert lines_run(lambda: read_spec(many)) <= SLACK * MORE * lines_run(lambda: read_spec(few))


def test_only_the_first_problems_are_put_into_words() -> None:
    """A search for the key that was meant is dear: 8000 of them took seconds."""
    with pytest.raises(SpecError) as caught:
        read_spec(TEXTS["keys that nearly are some"](8000))
    assert len(caught.value.problems) == MOST_PROBLEMS + 1
    assert caught.value.problems[-1] == ("spec", f"{8000 - MOST_PROBLEMS} more problems like these")
    few = lines_run(lambda: read_spec(TEXTS["keys that nearly are some"](100)))
    assert lines_run(lambda: read_spec(TEXTS["keys that nearly are some"](800))) <= 1.5 * few


@pytest.mark.parametrize("text", [f'{{"a":[{items("1", 20_001)}]}}', f"{{{keys(20_001)}}}"], ids=["list", "table"])
def test_more_values_than_any_spec_has_are_refused_unread(text: str) -> None:
    with pytest.raises(Problem, match="more than 20000 values"):
        read_spec(text)
    assert lines_run(lambda: read_spec(text)) < 1000


def test_the_largest_measured_light_is_taken() -> None:
    rows = [[(row * 128 + column) / 1e5 for column in range(128)] for row in range(128)]
    read_spec(json.dumps({"optics": {"light": {"profile": rows}}}, indent=1))


def test_what_a_job_was_asked_with_is_found_without_its_light() -> None:
    """Each key is left out on trial; the 16,384 values of a measured light are copied once, not for each of them."""

    def resolved(side: int) -> dict[str, Any]:
        rows = [[float(row + column) for column in range(side)] for row in range(side)]
        return resolve_spec(base={"optics": {"light": {"profile": rows}}}).model_dump(mode="json")

    small, large = resolved(4), resolved(64)
    assert reduce_spec(large) == {"optics": {"light": {"profile": large["optics"]["light"]["profile"]}}}
    assert lines_run(lambda: reduce_spec(large)) <= 1.5 * lines_run(lambda: reduce_spec(small))


def test_a_content_type_is_short(server: ApiServer) -> None:
    """The parser of its parameters looks at the whole of it again for each."""
    kind = 'multipart/form-data; boundary="' + ";" * 20_000
    answer = server.client.post("/v1/jobs", content=b"--x--", headers={"Content-Type": kind})
    assert "longer than 300" in problem(answer, 400, "Content-Type")["detail"]
