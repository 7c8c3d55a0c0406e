"""The imports of the fork server before any fork, and the function by which a child carries out its order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from service.job.stages.order import StageOrder
from service.job.stages.preload import LATER  # and the libraries that compute the lens, imported once for all children
from service.job.stages.run import run_order
from service.settings import ServerSettings
from service.store.opening import open_store

__all__ = ["LATER", "run_stage"]


def run_stage(order: dict[str, Any], on_progress: Callable[[float], None]) -> dict[str, Any]:
    """Return the stage that `order` (StageOrder.plain) asks for, with the store of the environment's settings."""
    settings = ServerSettings.load()
    return run_order(StageOrder.from_plain(order), open_store(settings), on_progress, plans=settings.plans).plain()
