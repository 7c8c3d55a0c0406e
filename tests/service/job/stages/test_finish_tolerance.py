"""How exactly a finish has to be hit: figures from what was simulated, and the sentences they make."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from optics.finish import Finish
from service.job.report.finishing import list_finish_tolerance, make_finishing_card
from service.job.spec.resolve import look_up
from service.job.stages.as_finished import LOSS_DB, find_limit, minutes_ratio, work_longer
from tests.service.job.stages.jobs import tiny_spec

FOUND = {"psnr_db": [24.5, 26.3, 22.3], "minutes_ratio": [0.8, 1.25], "within_ratio": [0.85, 1.1], "loss_db": 1.0}
TOLD: dict[str, Any] = {"title": "Felt", "minutes": 100.0, "pad_mm": 10.0, "steps": ["Polish."]}


@given(st.floats(-5.0, 20.0), st.sampled_from([0.64, 0.8, 1.25, 1.5625]))
def test_the_limit_is_where_one_decibel_is_lost_and_never_beyond_what_was_simulated(
    loss_db: float, ratio: float
) -> None:
    limit = find_limit(loss_db, ratio)
    assert min(ratio, 1.0) <= limit <= max(ratio, 1.0)
    share = math.log(limit) / math.log(ratio)
    assert loss_db * share**2 == pytest.approx(min(loss_db, LOSS_DB))


@pytest.mark.parametrize(
    ("values", "order", "ratio"),
    [
        (('finish.process="felt"',), 1.0, 1.25),
        (('finish.process="sanding"',), 2.0, 1.25**2),
        (('finish.process="vapour"',), 4.0, 1.25**1.6),
        (("finish.k0_rad_per_mm=3", "finish.order=4"), 4.0, 1.25**4),
    ],
)
def test_minutes_lead_to_k0_as_the_process_has_it(values: tuple[str, ...], order: float, ratio: float) -> None:
    job = look_up(tiny_spec(*values))
    finish = Finish(k0_rad_per_mm=3.0, order=order, depth_mm=0.01)
    assert minutes_ratio(job, finish, 0.8) == pytest.approx(ratio)
    longer = work_longer(finish, 0.8, ratio)
    assert longer.k0_rad_per_mm == pytest.approx(2.4) and longer.depth_mm == pytest.approx(0.01 * ratio)


def test_the_minutes_come_first_and_then_what_too_little_and_too_much_show() -> None:
    first, second, third, fourth = list_finish_tolerance({"finish_tolerance": FOUND, "finishing": TOLD})
    assert (
        "Finish for 1 h 40 min; up to 15 min less or 10 min more" in first
        and "about 1 dB of the predicted 26.3 dB" in first
    )
    assert "1 h 20 min: 24.5 dB" in second and "2 h 5 min: 22.3 dB" in second
    assert "Too little is safer" in third and "10 mm" in fourth


def test_work_that_no_clock_measures_is_said_in_percent() -> None:
    first, second, *_ = list_finish_tolerance({"finish_tolerance": FOUND, "finishing": {**TOLD, "minutes": None}})
    assert "up to 15 % less or 10 % more" in first and "80 % of the work: 24.5 dB" in second


def test_too_little_is_called_safer_only_where_it_is() -> None:
    found = {**FOUND, "psnr_db": [21.0, 26.0, 25.0]}
    assert not any("safer" in one for one in list_finish_tolerance({"finish_tolerance": found, "finishing": TOLD}))


def test_without_figures_the_card_says_nothing_of_it() -> None:
    card = make_finishing_card({"finishing": TOLD})
    assert card is not None and card["tolerance"] == [] and card["witness"] is None
