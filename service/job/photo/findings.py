"""Findings of photographs, as codes and values; and the table of sentences for photographs of the wall."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import reduce
from typing import Any, ClassVar

from phrases.phrase import Phrase, join
from service.errors import PictureError

Values = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding of a photograph. `code` is a key of `sentences`; `values` are the values of its sentence."""

    sentences: ClassVar[Mapping[str, Callable[[Values], Phrase]]]
    code: str
    values: dict[str, Any] = field(default_factory=dict)

    def sentence(self) -> Phrase:
        return self.sentences[self.code](self.values)

    def plain(self) -> dict[str, Any]:
        return {"code": self.code, "values": self.values, "text": self.sentence()}


class UselessPhotoError(PictureError):
    """A photograph of no use, with the reason."""

    def __init__(self, name: str, finding: Finding) -> None:
        super().__init__(Phrase("{name}: {sentence}", name=name, sentence=finding.sentence()))
        self.finding = finding


_PREDICTED_AS = {
    "finished": Phrase("as finished"),
    "milled": Phrase("as milled"),
    "designed": Phrase("as designed"),
}

SENTENCES: dict[str, Callable[[Values], Phrase]] = {
    "no_light": lambda v: Phrase("the photograph is one tone all over; photograph the lit wall in a dark room"),
    "too_dark": lambda v: Phrase(
        "too dark: its brightest parts reach {peak_percent:.2g} % of white, allowed: {least_percent:g} % at least; "
        "expose longer, on a stand", **v
    ),
    "too_bright": lambda v: Phrase(
        "too bright: {clipped_percent:.0f} % of the picture is white and shows nothing, allowed: {most_percent:.0f} %; "
        "expose less, by one or two stops", **v
    ),
    "too_small": lambda v: Phrase(
        "the lit picture is {across_px:.0f} pixels wide in it, allowed: {least_px:.0f} at least; go nearer, or send "
        "the photograph in full size", **v
    ),
    "cut_off": lambda v: Phrase(
        "it shows {seen_percent:.0f} % of the lit picture, allowed: {least_percent:.0f} % at least; photograph all of "
        "it with some dark wall around", **v
    ),
    "not_this_lens": lambda v: Phrase(
        "the photograph does not show what the lens of this job should show (likeness {likeness:.2f}, allowed: "
        "{least:.2f} at least); is it this job's lens, focused, in a dark room, and all of it lit?", **v
    ),
    "mirrored": lambda v: Phrase(
        "the photograph shows the picture mirrored: a selfie camera does that; otherwise it shows the other side "
        'of the wall than optics.viewed_from = "{viewed_from}" says', **v
    ),
    "wall_too_far": lambda v: Phrase(
        "the wall stands {mm:.2g} mm (± {deviation_mm:.1g} mm) too far: move it nearer to the lens by that much", **v
    ),
    "wall_too_near": lambda v: Phrase(
        "the wall stands {mm:.2g} mm (± {deviation_mm:.1g} mm) too near: move it away from the lens by that much", **v
    ),
    "wall_in_place": lambda v: Phrase("the wall's distance is right within {within_mm:.2g} mm", **v),
    "wall_unknown": lambda v: Phrase(
        "this photograph does not give the wall's distance to better than {within_mm:.2g} mm; check with a rule "
        "that it is {throw_mm:g} mm from the top of the block", **v
    ),
    "wall_tilted": lambda v: Phrase(
        "the wall leans by {deg:.2g}° (± {deviation_deg:.1g}°) against the block: its {side} is too far away; square "
        "the block and the wall to each other", **v, side=_side(v)
    ),
    "light_aslant": lambda v: Phrase(
        "the light is tilted by {deg:.2g}° (± {deviation_deg:.1g}°), towards the picture's {side}: turn the lamp, "
        "or block and wall together", **v, side=_side(v)
    ),
    "turned": lambda v: (
        Phrase(
            "the picture is turned by {turned_deg:.1f}° clockwise in the photograph: if the camera was level, turn "
            "the block by that much counter-clockwise", turned_deg=abs(v["deg"])
        )
        if v["deg"] > 0
        else Phrase(
            "the picture is turned by {turned_deg:.1f}° counter-clockwise in the photograph: if the camera was level, "
            "turn the block by that much clockwise", turned_deg=abs(v["deg"])
        )
    ),
    "softer": lambda v: Phrase(
        "the light is softer than predicted {how}, by {mm:.2g} mm on the wall (the prediction itself: "
        "{foretold_mm:.2g} mm): {causes}", **v, how=_PREDICTED_AS[v["foretold"]], causes=_why_softer(v)
    ),
    "sharper": lambda v: Phrase(
        "the light is sharper than predicted {how}, by {mm:.2g} mm on the wall: mill and finish did better than "
        "their figures say", **v, how=_PREDICTED_AS[v["foretold"]]
    ),
    "as_soft_as_foretold": lambda v: Phrase(
        "the light is as sharp as predicted {how}", how=_PREDICTED_AS[v["foretold"]]
    ),
    "surface_off": lambda v: Phrase(
        "the surface is off by {peak_to_valley_um:.2g} µm from highest to lowest: {terms}",
        peak_to_valley_um=v["peak_to_valley_um"], terms=_terms(v)
    ),
    "surface_right": lambda v: Phrase(
        "no long-wave error of the surface is seen (of those that can be measured, none is over {within_um:.2g} µm)",
        **v,
    ),
    "surface_unknown": lambda v: Phrase("this photograph shows nothing of long-wave errors of the surface"),
    "partly_clipped": lambda v: Phrase(
        "{clipped_percent:.0f} % of the picture is white in the photograph and was left out: a shorter exposure tells "
        "more", **v
    ),
    "rather_dark": lambda v: Phrase("the photograph is rather dark: a longer exposure tells more"),
    "odd_tones": lambda v: Phrase(
        "the camera has changed the tones (a power of {tone:.2f}): photograph without filters or HDR for surer figures",
        **v
    ),
}  # fmt: skip


class PhotoFinding(Finding):
    """A finding of a photograph of the wall."""

    sentences = SENTENCES


_NAMES = {
    (2, 0): Phrase("bow from left to right and the other way from bottom to top"),
    (1, 1): Phrase("twist"),
    (3, 0): Phrase("S shape from left to right"),
    (2, 1): Phrase("bow from left to right that changes from bottom to top"),
    (1, 2): Phrase("bow from bottom to top that changes from left to right"),
    (0, 3): Phrase("S shape from bottom to top"),
    (4, 0): Phrase("W shape from left to right"),
    (3, 1): Phrase("S shape from left to right that changes from bottom to top"),
    (2, 2): Phrase("saddle of the corners"),
    (1, 3): Phrase("S shape from bottom to top that changes from left to right"),
    (0, 4): Phrase("W shape from bottom to top"),
}


_SIDES = {"left": Phrase("left"), "right": Phrase("right"), "top": Phrase("top"), "bottom": Phrase("bottom")}


def _side(v: Values) -> Phrase:
    sides = map(_SIDES.__getitem__, v["sides"])
    return reduce(lambda names, name: Phrase("{names} and {name}", names=names, name=name), sides)


def _terms(v: Values) -> Phrase:
    return join(
        ", ",
        (
            Phrase(
                "{form} {um:+.1f} µm (± {deviation_um:.1f})", form=_NAMES[row["order_x"], row["order_y"]], um=row["um"],
                deviation_um=row["deviation_um"],
            )
            for row in v["terms"]
        ),
    )  # fmt: skip


def _why_softer(v: Values) -> Phrase:
    return Phrase(
        "{cause}, the lamp is larger (one that looks {source_deg:.2g}° wide would do it), or the camera was out of "
        "focus",
        cause=Phrase("the finish is not yet done")
        if v["foretold"] == "finished"
        else Phrase("mill or finish leave more than predicted"),
        source_deg=v["source_deg"],
    )
