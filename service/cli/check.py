"""The command `check`: its arguments, what it calls, and its exit code.

Everything heavy is imported inside, so that --help answers at once.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import QuietOption
from service.errors import EXIT_FAILURE


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(check)


def check(
    programs: Annotated[list[Path], typer.Argument(metavar="PROGRAM...", help="Programs in the order they are run.")],
    heightfield: Annotated[Path, typer.Option("--heightfield", metavar="FILE", help="The lens: heightfield.npz.")],
    radius_mm: Annotated[
        list[float] | None, typer.Option("--radius-mm", help="Ball radius of each program; one serves all.")
    ] = None,
    pitch_mm: Annotated[list[float] | None, typer.Option("--pitch-mm", help="Pitch of each program.")] = None,
    stock_to_leave_mm: Annotated[
        list[float] | None, typer.Option("--stock-to-leave-mm", help="Stock each program leaves; default 0.")
    ] = None,
    step_down_mm: Annotated[
        list[float] | None, typer.Option("--step-down-mm", help="Most stock one move may take off.")
    ] = None,
    thickness_mm: Annotated[float | None, typer.Option("--thickness-mm", help="Thickness of the block.")] = None,
    margin_mm: Annotated[float | None, typer.Option("--margin-mm", help="Margin of the block.")] = None,
    machine: Annotated[str | None, typer.Option("--machine", help="Machine profile.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Simulate the removal of written programs; exit code 1 on a gouge or a crash.

    Beside a job's spec.json all settings come from there, and the job's earlier passes are run first.
    """
    from service.job.checking import CheckSettings, check_programs
    from service.progress import report_progress

    settings = CheckSettings(
        radius_mm=tuple(radius_mm or ()),
        pitch_mm=tuple(pitch_mm or ()),
        stock_to_leave_mm=tuple(stock_to_leave_mm or ()),
        step_down_mm=tuple(step_down_mm or ()),
        thickness_mm=thickness_mm,
        margin_mm=margin_mm,
        machine=machine,
    )
    with report_progress(quiet) as reporter:
        verdicts = check_programs(programs, heightfield, settings, reporter=reporter)
    for verdict in verdicts:
        if not quiet or not verdict.ok:
            print(verdict.line(), file=sys.stdout if verdict.ok else sys.stderr)
    if not all(verdict.ok for verdict in verdicts):
        raise typer.Exit(EXIT_FAILURE)
