"""The commands that measure photographs, `coupon` of a test piece and `look` of the wall: arguments and calls.

Everything heavy is imported inside the commands, so that --help is fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import QuietOption
from service.processes.kernel_cache import JOBS


def register(app: typer.Typer) -> None:
    """Add the commands of this module to the command line."""
    app.command("coupon")(draw_coupon)
    app.command()(look)


def draw_coupon(
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the test piece.")],
    photo: Annotated[
        Path | None,
        typer.Option("--photo", metavar="FILE", help="A photograph of its light, from which to measure the finish."),
    ] = None,
    machine: Annotated[str | None, typer.Option("--machine", metavar="NAME", help="Machine profile.")] = None,
    throw_mm: Annotated[
        float | None, typer.Option("--throw-mm", help="From the block's top to the screen; default 20.")
    ] = None,
    finish: Annotated[
        str | None,
        typer.Option("--finish", metavar="NAME", help="Finish to predict; default sanding."),
    ] = None,
    spec: Annotated[Path | None, typer.Option("--spec", metavar="FILE", help="Job spec, TOML or JSON.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One value of the spec. Repeatable.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Allow a folder that holds other files.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Make a test piece that measures your mill and your finish, or, with --photo, measure them from a photograph."""
    from service.errors import InputError
    from service.progress import report_progress

    if photo is not None:
        given = {"--machine": machine, "--throw-mm": throw_mm, "--finish": finish, "--spec": spec, "--set": set_}
        if wrong := [name for name, value in given.items() if value]:
            raise InputError(
                f"{wrong[0]}: not allowed with --photo, for a test piece made earlier; allowed: -o DIR, --quiet"
            )
        from service.job.coupon import findings, piece

        with report_progress(quiet) as reporter:
            result = findings.measure_coupon(photo, output, reporter=reporter)
        if not quiet:
            for line in findings.print_findings(result):
                print(line)
            print(f"figures for a job's spec: {output / piece.FIT_SNIPPET}; the curve: {output / piece.FIT_PICTURE}")
        return
    from service.server.worker import warmup

    with warmup.compile_beside(JOBS):
        from service.job.coupon import piece, programs

        overrides = list(set_ or ())
        overrides += [] if finish is None else [f"finish.process={finish}"]
        resolved = piece.coupon_job(machine=machine, throw_mm=throw_mm, file=spec, overrides=overrides)
        with report_progress(quiet) as reporter:
            report = programs.make_coupon(output, resolved, reporter=reporter, force=force)
    if not quiet:
        for line in piece.summary_lines(output, report):
            print(line)


def look(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="A photograph of the lens's light on the wall.")],
    job: Annotated[Path, typer.Option("--job", metavar="DIR", help="The folder of the job that made the lens.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for look.png and look.json; default: this one.")
    ] = None,
    width_mm: Annotated[
        float | None,
        typer.Option(
            "--width-mm", help="Width of the lit rectangle on the wall, if measured: gives a more certain distance."
        ),
    ] = None,
    marks: Annotated[
        bool,
        typer.Option("--marks", help="The photograph shows the light of the witness marks: how far the finish is."),
    ] = False,
    minutes: Annotated[
        float | None, typer.Option("--minutes", min=0.01, help="With --marks: minutes worked so far, for the pace.")
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Compare a photograph of the wall with the prediction, and say what is off and what to do."""
    if marks:
        _look_at_marks(photo, job, minutes)
        return
    from service.job import files as job_files
    from service.job.photo.looking import LOOK_FIGURES, LOOK_PICTURE, look_at_photo
    from service.progress import report_progress

    folder = out or Path()
    with report_progress(quiet) as reporter:
        found = look_at_photo(photo, job, picture_width_mm=width_mm, reporter=reporter)
        picture = found.png()
    folder.mkdir(parents=True, exist_ok=True)
    job_files.write_bytes(folder / LOOK_PICTURE, picture)
    job_files.write_json(folder / LOOK_FIGURES, found.figures)
    if not quiet:
        for finding in found.findings:
            print(finding.sentence())
        print(f"picture: {folder / LOOK_PICTURE}")


def _look_at_marks(photo: Path, job: Path, minutes: float | None) -> None:
    """Print how far the finish is, even with --quiet: there is no other result."""
    from service.job.photo.witness import read_witness_photo

    for sentence in read_witness_photo(photo, job, worked_minutes=minutes).sentences():
        print(sentence)
