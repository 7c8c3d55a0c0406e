"""Disk space: asked before a job is taken, while its picture comes, and for the programs that it would make."""

from __future__ import annotations

import shutil
from typing import Any

from phrases.phrase import Phrase
from service.http.problems import Problem
from service.job.planning.program_size import SURE, job_bytes
from service.job.spec.model import JobSpec
from service.settings import ServerSettings

_RETRY = {"Retry-After": "60"}


def too_little_space(free_mb: float, needed_mb: int) -> Phrase:
    return Phrase("{free_mb:.0f} MB are free; new jobs need {needed_mb} MB", free_mb=free_mb, needed_mb=needed_mb)


class Space:
    """The disk of the data folder."""

    def __init__(self, settings: ServerSettings) -> None:
        self._folder = settings.data
        self._floor_mb = settings.free_disk_mb
        self._makes_programs = settings.embedded and settings.store_url is None

    def require(self, coming_bytes: int = 0) -> None:
        """Raise Problem 507 where less is free, or would be after so much more, than the settings want to stay free."""
        free_mb = self._free_mb()
        if free_mb - coming_bytes / 1e6 < self._floor_mb:
            raise Problem(507, too_little_space(free_mb, self._floor_mb), headers=_RETRY)

    def require_for_programs(self, spec: dict[str, Any]) -> None:
        """Raise Problem 507 for a job whose programs this disk cannot hold; of other computers' disks nothing is
        known.
        """
        if not self._makes_programs:
            return
        wanted_mb, free_mb = job_bytes(JobSpec.model_validate(spec)) / 1e6, self._free_mb()
        if free_mb < wanted_mb / SURE:
            words = Phrase(
                "the programs need about {wanted_mb:.0f} MB, {disk} has {free_mb:.0f} MB free",
                wanted_mb=wanted_mb,
                disk=Phrase("the server's disk"),
                free_mb=free_mb,
            )
            raise Problem(507, words, field="spec.passes")

    def _free_mb(self) -> float:
        return shutil.disk_usage(self._folder).free / 1e6
