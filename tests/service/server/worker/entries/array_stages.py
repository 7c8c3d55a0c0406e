"""Stages that compute, found by the fork server as `array_stages:run`: kernels on threads, BLAS, a sparse solve."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import scipy.sparse
import scipy.sparse.linalg

from optics.threads import run_on_rows, thread_count


@numba.njit(nogil=True)
def row_sums(first, end, values):
    total = 0.0
    for row in range(first, end):
        for column in range(values.shape[1]):
            total += values[row, column]
    return total


@numba.njit(nogil=True)
def spin(first, end, seconds):
    x = 1.0
    for _ in range(int(seconds * 1e9)):
        x = (x * 1.0000001) % 7.0
    return x


def run(order, on_progress):
    return globals()[order["do"]](order)


def compute(order):
    generator = np.random.default_rng(1)
    values = generator.random((500, 400))
    strips = run_on_rows(row_sums, 500, values)
    matrix = scipy.sparse.diags([-1.0, 4.0, -1.0], [-1, 0, 1], shape=(1000, 1000), format="csc")
    solved = scipy.sparse.linalg.spsolve(matrix, np.ones(1000))
    product = values.T @ values
    return {
        "strips": len(strips) == min(thread_count(), 500),
        "sum_error": abs(sum(strips) - float(values.sum())),
        "solve_error": float(abs(matrix @ solved - 1.0).max()),
        "product": product.tobytes().hex()[:64],
    }


def spin_kernel(order):
    run_on_rows(spin, 2, 1e-6)
    Path(order["tell"]).write_text("ready")
    run_on_rows(spin, 2, 60.0)
    return {}
