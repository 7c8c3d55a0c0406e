"""The setup sheet from a report, as HTML text."""

from __future__ import annotations

from typing import Any

from service.job.report.setup_sheet import describe_setup, render_page


def render_report(report: Any, **given: Any) -> str:
    return render_page(describe_setup(report, **given))
