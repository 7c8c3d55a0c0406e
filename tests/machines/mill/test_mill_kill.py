"""Whoever owns the mill may die at any moment: the run is found, recovered, and nothing is skipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.trials.kill_trial import one_kill


@pytest.mark.parametrize("seed", range(30))
def test_every_segment_is_cut_in_order_after_kills_and_power_losses(seed: int, tmp_path: Path) -> None:
    trial = one_kill(seed, tmp_path)
    assert trial.faults == []


def test_the_trials_kill_and_recut(tmp_path: Path) -> None:
    """Guards the test above: trials in which nothing dies would prove nothing."""
    trials = [one_kill(seed, tmp_path / str(seed), 60) for seed in range(6)]
    assert sum(trial.kills for trial in trials) >= 4
    assert any(trial.recut for trial in trials)
