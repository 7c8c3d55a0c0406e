"""Which tests stay together, and which begin first, when several processes share them.

A file of tests stays in one process, so that what its tests share is made once; the files of some folders, whose tests
share a server and its jobs, do so together. What takes minutes begins early: at the end nobody waits for one that has
just begun. And no two begin with a job, whose kernels both would have to compile.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from xdist.scheduler import LoadFileScheduling

TOGETHER = ("tests/page/journeys/", "tests/service/client/")
FIRST = (
    "tests/service/job/stages/test_whole_job.py",  # compiles what a job needs, beside what needs less
    "tests/service/server/worker/",
    "tests/service/server/fleet/",
    "tests/page/journeys/",
    "tests/service/server/supervisor/",
    "tests/disturbances/",
    "tests/service/milling/terminal/test_stream.py",
    "tests/service/milling/terminal/test_recover.py",
    "tests/end_to_end/test_refused_before.py",
    "tests/service/client/",
    "tests/page/",
    "tests/service/job/planning/",
    "tests/end_to_end/",
    "tests/optics/test_any_bench.py",
    "tests/service/job/stages/",
    "tests/docker/",
    "tests/test_documents.py",
    "tests/cam/as_milled/test_as_milled_brute_force.py",
    "tests/cam/contour/test_contour_path.py",
    "tests/optics/test_hard_pictures.py",
    "tests/service/server/api/",
    "tests/service/milling/agent/test_process.py",
    "tests/optics/coupon/",
    "tests/service/job/coupon/",
    "tests/service/cli/test_coupon.py",
    "tests/test_paper_figures.py",
)
_TOP = Path(__file__).parents[1]


def in_good_order(items: list[pytest.Item]) -> None:
    """In place; the order within a file stays."""
    items.sort(key=lambda item: _rank(item.path.relative_to(_TOP).as_posix()))


def _rank(path: str) -> int:
    return next((rank for rank, beginning in enumerate(FIRST) if path.startswith(beginning)), len(FIRST))


def processes() -> int:
    """Five for two processors: tests of servers and mills wait much of their time; six are no faster."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return 5 * processors // 2


class Scheduling(LoadFileScheduling):
    """xdist's `loadfile`, in the order of the collection, with some folders for files."""

    def __init__(self, config: pytest.Config, log: object = None) -> None:
        config.option.loadscopereorder = False
        super().__init__(config, log)

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return next((folder for folder in TOGETHER if file.startswith(folder)), file)
