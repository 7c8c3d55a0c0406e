"""`[finish.bob]`: off unless the shop has one, within what mill and heat allow, and one finish among others."""

from __future__ import annotations

from typing import Any

import pytest

from service.errors import SpecError
from service.job.planning.finish_choice import list_finishings
from service.job.spec.lens_task import finish_of
from service.job.spec.loading import resolve_job
from service.job.stages.table import plan

SMALL = {"optics": {"width_mm": 30.0, "height_mm": 30.0}, "image": {"pixels": 64}, "preset": "draft"}


def resolve(finish: dict[str, Any], **tables: Any) -> Any:
    return resolve_job(base={**SMALL, "finish": finish, **tables})


def test_a_bob_polishes_after_the_passes() -> None:
    job = resolve({"process": "bob", "bob": {}})
    assert plan(job.spec).index("pass-polish") == plan(job.spec).index("pass-2") + 1
    assert "pass-witness" not in plan(job.spec)
    finish = finish_of(job.spec)
    assert finish is not None and finish.depth_mm is not None
    assert finish.order == 0.85 and finish.off_doses == (0.8, 1.2) and finish.off_orders == ()
    assert job.spec.finish.bob.spindle_rpm == 10_000.0


@pytest.mark.parametrize(
    ("finish", "machine", "key", "words"),
    [
        ({"process": "bob"}, "grbl", "finish.bob", "is missing"),
        ({"process": "bob", "bob": {"radius_mm": 12.0}}, "grbl", "finish.bob.radius_mm", "8000 rpm.*m/s.*at most"),
        ({"process": "bob", "bob": {"spindle_rpm": 900.0}}, "grbl", "finish.bob.spindle_rpm", "8000 to 30000 rpm"),
        ({"process": "bob", "bob": {"compression_mm": 1.0}}, "grbl", "finish.bob.compression_mm", "at most 0.75"),
    ],
)
def test_what_mill_or_heat_forbid_is_refused_in_one_line(
    finish: dict[str, Any], machine: str, key: str, words: str
) -> None:
    with pytest.raises(SpecError, match=words) as refused:
        resolve(finish, machine={"profile": machine})
    assert str(refused.value).count("\n") == 0 and str(refused.value).startswith(key)


def test_best_weighs_a_bob_only_where_the_shop_has_one() -> None:
    """Its minutes are the mill's, and k0 falls with them as of the bob's own depth."""
    spec = {"preset": "recommended"}
    without, owned = (
        {one.process for one in list_finishings(resolve({"process": "best", **more}, **spec))}
        for more in ({}, {"bob": {}})
    )
    assert "bob" not in without and owned == without | {"bob"}
