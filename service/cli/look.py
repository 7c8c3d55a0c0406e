"""The command `look`: its arguments, and what it calls.

Everything heavy is imported inside the command, so that --help answers at once.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import QuietOption


def register(app: typer.Typer) -> None:
    """Add the command of this module to the command line."""
    app.command()(look)


def look(
    photo: Annotated[Path, typer.Argument(metavar="PHOTO", help="A photograph of the lens's light on the wall.")],
    job: Annotated[Path, typer.Option("--job", metavar="DIR", help="The folder of the job that made the lens.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where look.png and look.json go; by default here.")
    ] = None,
    width_mm: Annotated[
        float | None,
        typer.Option("--width-mm", help="How wide the lit rectangle is on the wall, if measured: a surer distance."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """What the wall tells: compare a photograph with what was foretold, and say what is off and what to do."""
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
