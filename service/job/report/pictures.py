"""The pictures that the stages of a job draw: folders, the setup sheet and the page all use this table.

To add one: a row here, a function in `figures/` that draws it, and in the stage `context.draw(NAME, ...)`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from phrases.phrase import Phrase

Part = Literal["lens", "light", "programs"]

PredictedKind = Literal["finished", "milled", "designed"]
PREDICTED: dict[PredictedKind, str] = {"finished": "caustic-as-finished.png", "milled": "caustic-as-milled.png"}
"""What a photograph of the wall is compared with, the best first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportPicture:
    """A file of a job, PNG. The order of the table is that of the sheet and of the page.

    part    : part of the job: new programs for the same lens leave the pictures of lens and light unchanged
    title   : in the page's list of files; wall: on its pictures as well
    caption : on the setup sheet
    shown   : "wall": the light on the wall: first on the sheet, and on the page over any other such picture;
              "page": by itself on the sheet and on the page; "sheet": on the sheet alone; "finish": beside the
              instructions for the finish
    note    : after the title, on the page's pictures
    """

    name: str
    part: Part
    title: str
    caption: Phrase
    shown: Literal["wall", "page", "sheet", "finish"] = "sheet"
    note: str = ""


PICTURES = (
    ReportPicture(
        name="target.png",
        part="lens",
        title="Target",
        note="what the light is to paint",
        caption=Phrase("The target: the picture the lens is to paint."),
        shown="wall",
    ),
    ReportPicture(
        name="caustic.png",
        part="light",
        title="Ideal caustic",
        note="of the lens as designed, before the tool blurs it",
        caption=Phrase("The simulated caustic: what a perfect surface paints on the wall, at the same exposure."),
        shown="wall",
    ),
    ReportPicture(
        name="caustic-as-milled.png",
        part="light",
        title="As milled",
        note="with all marks of the tool",
        caption=Phrase("The simulated caustic of the surface as the programs leave it."),
        shown="wall",
    ),
    ReportPicture(
        name="caustic-as-finished.png",
        part="light",
        title="As finished",
        note="after the work by hand: what the wall will show",
        caption=Phrase(
            "The simulated caustic of the surface as the finish by hand leaves it: what the wall will show."
        ),
        shown="wall",
    ),
    ReportPicture(
        name="prepared.png",
        part="lens",
        title="As given and prepared",
        caption=Phrase(
            "The picture as given, and prepared for the wall: contrast is raised in what is large enough to show."
        ),
        shown="page",
    ),
    ReportPicture(
        name="comparison.png",
        part="light",
        title="Caustic against target",
        caption=Phrase("Target, simulated caustic and the difference between them."),
    ),
    ReportPicture(
        name="comparison-as-finished.png",
        part="light",
        title="As finished against target",
        caption=Phrase("Target, the picture after finishing by hand and the difference between them."),
    ),
    ReportPicture(
        name="finish-tolerance.png",
        part="light",
        title="Finished too little and too much",
        caption=Phrase(
            "What the wall shows after too little of the finish, as planned, and after too much, at the same exposure."
        ),
        shown="finish",
    ),
    ReportPicture(
        name="as-milled.png",
        part="light",
        title="As milled against design",
        caption=Phrase(
            "Target, design and the surface that the programs leave, whole and in the part with the most detail. "
            "The last one counts the grooves of every move, the steps of the machine and its height errors."
        ),
    ),
    ReportPicture(
        name="through-focus.png",
        part="light",
        title="Out of focus",
        caption=Phrase(
            "The same lens with the screen at other distances. It is in focus only at the distance it is made for."
        ),
    ),
    ReportPicture(
        name="tolerances.png",
        part="light",
        title="Tolerances of the set-up",
        caption=Phrase(
            "When the set-up is not exact: the wall at another distance, tilted light (the picture's shift taken "
            "out), and a source of another size. Simulated with fewer rays than the scores above, so the two may "
            "differ by a decibel or two: what counts is the loss along a curve."
        ),
    ),
    ReportPicture(
        name="lens.png",
        part="lens",
        title="Lens from above",
        caption=Phrase(
            "The lens surface from above, as it lies on the mill: heights with contour lines, and its relief."
        ),
    ),
    ReportPicture(
        name="flow.png",
        part="lens",
        title="Steps of the design",
        caption=Phrase(
            "The paper's method step by step: how the mapping grows and the difference D fades (its Fig. 6)."
        ),
    ),
    ReportPicture(
        name="plan.png",
        part="programs",
        title="Plans to choose from",
        caption=Phrase("Passes to choose from: what the wall shows after more or fewer hours. The choice is marked."),
    ),
    ReportPicture(
        name="envelope.png",
        part="programs",
        title="Block and tool under the head",
        caption=Phrase(
            "The tool that sticks out farthest, between the table and the head: at its lowest beside the clamps, and "
            "where rapids cross and programs begin and end."
        ),
        shown="page",
    ),
    ReportPicture(
        name="toolpath.png",
        part="programs",
        title="Paths of the programs",
        caption=Phrase(
            "Each program from above. Left: some rows of the whole part. Right: every move in a small square."
        ),
    ),
)


def list_pictures(part: Part) -> Iterator[str]:
    """Yield the names of the pictures of one part of a job."""
    return (picture.name for picture in PICTURES if picture.part == part)
