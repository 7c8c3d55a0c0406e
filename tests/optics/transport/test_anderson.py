"""Anderson mixing: the laws of a linear problem, and the same bytes from any number of threads."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from optics.transport import anderson
from optics.transport.anderson import Anderson


def iterates(matrix: np.ndarray, aim: np.ndarray, steps: int, depth: int) -> list[float]:
    """Misses |aim - matrix x| of x += aim - matrix x, mixed."""
    memory, x, misses = Anderson(aim.size, depth, np.float64), np.zeros(aim.size), []
    for _ in range(steps):
        miss = aim - matrix @ x
        misses.append(float(np.linalg.norm(miss)))
        x = memory.find_next(x + miss, miss.astype(np.float32), 0.0)
    return misses


@hypothesis_settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), different=st.integers(1, 6))
def test_as_many_steps_as_there_are_eigenvalues(seed: int, different: int) -> None:
    """On a linear problem mixing with enough memory is GMRES: exact after one step per distinct eigenvalue, and one."""
    rng = np.random.default_rng(seed)
    values = np.linspace(0.3, 3.0, different)[rng.integers(0, different, 40)]
    turn, _ = np.linalg.qr(rng.normal(size=(40, 40)))
    misses = iterates(turn @ np.diag(values) @ turn.T, rng.normal(size=40), different + 2, depth=8)
    assert misses[-1] < 1e-5 * misses[0]  # residuals are remembered in single precision


def test_plain_iteration_would_diverge_where_mixing_converges() -> None:
    values = np.linspace(0.2, 5.0, 30)
    misses = iterates(np.diag(values), np.ones(30), 40, depth=16)
    assert np.abs(1 - values).max() > 3
    assert misses[-1] < 1e-4 * misses[0]


def test_the_further_component_counts() -> None:
    """Where the pixels' residual says nothing, the further one decides: x <- x + 0.1 (2 - x) is solved at once."""
    memory, x = Anderson(5, 4, np.float64), np.zeros(5)
    for _ in range(3):
        miss = 2.0 - x[0]
        x = memory.find_next(x + 0.1 * miss, np.zeros(5, np.float32), miss)
    np.testing.assert_allclose(x, 2.0, atol=1e-9)


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
def test_bytes_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    def mixed(strips: int) -> bytes:
        def in_strips(kernel, rows, *arguments):  # type: ignore[no-untyped-def]
            bounds = [rows * s // strips for s in range(strips + 1)]
            return [kernel(lo, hi, *arguments) for lo, hi in pairwise(bounds)]

        monkeypatch.setattr(anderson, "run_on_rows", in_strips)
        rng = np.random.default_rng(0)
        memory, shape = Anderson(300 * 321, 4, np.float32), (300, 321)
        for _ in range(7):
            x = memory.find_next(rng.normal(size=shape), rng.normal(size=shape).astype(np.float32), 0.1)
        return x.tobytes()

    assert mixed(threads) == mixed(5)
