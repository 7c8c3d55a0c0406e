"""The commands `make`, `design`, `cam`, `caustic` and `check`: arguments and calls.

Everything heavy is imported inside the commands, so that --help is fast.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.options import QuietOption
from service.errors import EXIT_FAILURE, printable
from service.processes.kernel_cache import JOBS, LENSES

PictureArgument = Annotated[Path, typer.Argument(metavar="PICTURE", help="PNG, JPEG, TIFF, WebP, BMP or GIF.")]
FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="The folder of an earlier design or make.")]
OutputOption = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for all files of the job.")]
SpecOption = Annotated[Path | None, typer.Option("--spec", metavar="FILE", help="Job spec, TOML or JSON.")]
PresetOption = Annotated[
    str | None, typer.Option("--preset", metavar="NAME", help="Passes: paper, draft or recommended.")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One value, e.g. optics.width_mm=40. Repeatable.")
]
LightOption = Annotated[
    Path | None,
    typer.Option("--light-picture", metavar="FILE", help="Measured picture of the light on the aperture, rim to rim."),
]
MachineOption = Annotated[
    str | None, typer.Option("--machine", metavar="NAME", help="Machine profile; see `machines`.")
]
ForceOption = Annotated[bool, typer.Option("--force", help="Allow a folder that holds other files.")]


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command()(make)
    app.command()(design)
    app.command("cam")(make_programs)
    app.command("caustic")(simulate_caustic)
    app.command()(check)


def make(
    picture: PictureArgument,
    output: OutputOption,
    machine: MachineOption = None,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    light_picture: LightOption = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make lens, checked programs, previews and setup sheet from a picture.

    Without a preset, a spec or passes, plan them for picture and mill, with a finish by hand.
    """
    from service.server.worker import warmup

    with warmup.compile_beside(JOBS):
        from service.cli.summary import target_line
        from service.job import pipeline
        from service.job.spec.loading import default_layer, override_machine, resolve_job
        from service.progress import report_progress

        said: dict[str, Any] = {
            "file": spec,
            "preset": preset,
            "overrides": [*override_machine(machine), *(set_ or ())],
        }
        resolved = resolve_job(**said, base=default_layer(**said), light_picture=light_picture)
        if not quiet:
            print(printable(target_line(resolved.spec)))
        with report_progress(quiet) as reporter:
            report = pipeline.make(picture, output, resolved, reporter=reporter, force=force)
    _print_summary(output, report, quiet)


def design(
    picture: PictureArgument,
    output: OutputOption,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    light_picture: LightOption = None,
    force: ForceOption = False,
    quiet: QuietOption = False,
) -> None:
    """Make only the lens from a picture: heightfield, solid, simulated caustic. No programs."""
    from service.server.worker import warmup

    with warmup.compile_beside(LENSES):
        from service.job import pipeline
        from service.job.spec.loading import resolve_job
        from service.progress import report_progress

        resolved = resolve_job(file=spec, preset=preset, overrides=set_ or (), light_picture=light_picture)
        with report_progress(quiet) as reporter:
            report = pipeline.design(picture, output, resolved, reporter=reporter, force=force)
    _print_summary(output, report, quiet)


def make_programs(
    folder: FolderArgument,
    spec: SpecOption = None,
    preset: PresetOption = None,
    set_: SetOption = None,
    quiet: QuietOption = False,
) -> None:
    """Make checked programs for a lens, in the folder of an earlier design or make."""
    from service.job import pipeline
    from service.job.spec.loading import resolve_for_lens
    from service.progress import report_progress

    resolved = resolve_for_lens(folder, file=spec, preset=preset, overrides=set_ or ())
    with report_progress(quiet) as reporter:
        report = pipeline.make_programs(folder, resolved, reporter=reporter)
    _print_summary(folder, report, quiet)


def simulate_caustic(folder: FolderArgument, quiet: QuietOption = False) -> None:
    """Simulate the light of an earlier design again: scores, caustic, through-focus."""
    from service.job import pipeline
    from service.job.spec.loading import load_stored_job
    from service.progress import report_progress

    stored = load_stored_job(folder)
    with report_progress(quiet) as reporter:
        report = pipeline.simulate_caustic(folder, stored, reporter=reporter)
    _print_summary(folder, report, quiet)


def _print_summary(folder: Path, report: dict[str, Any], quiet: bool) -> None:
    if quiet:
        return
    from service.cli.summary import summary_lines

    for line in summary_lines(folder, report):
        print(printable(line))


def check(
    programs: Annotated[
        list[Path], typer.Argument(metavar="PROGRAM...", help="The programs, in the order in which they run.")
    ],
    heightfield: Annotated[Path, typer.Option("--heightfield", metavar="FILE", help="The lens: heightfield.npz.")],
    radius_mm: Annotated[
        list[float] | None, typer.Option("--radius-mm", help="Ball radius of each program; one value is used for all.")
    ] = None,
    pitch_mm: Annotated[list[float] | None, typer.Option("--pitch-mm", help="Pitch of each program.")] = None,
    stock_to_leave_mm: Annotated[
        list[float] | None, typer.Option("--stock-to-leave-mm", help="Stock that each program leaves; default 0.")
    ] = None,
    step_down_mm: Annotated[
        list[float] | None, typer.Option("--step-down-mm", help="Most stock one move may take off.")
    ] = None,
    thickness_mm: Annotated[float | None, typer.Option("--thickness-mm", help="Thickness of the block.")] = None,
    margin_mm: Annotated[float | None, typer.Option("--margin-mm", help="Margin of the block.")] = None,
    machine: Annotated[str | None, typer.Option("--machine", help="Machine profile.")] = None,
    quiet: QuietOption = False,
) -> None:
    """Check programs against the rules of the mill and simulate what they remove; exit code 1 on a fault.

    A job's spec.json beside them gives all settings, and the job's earlier passes are simulated first.
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
