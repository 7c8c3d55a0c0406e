"""What a photograph of the wall told, as codes and values, and the one table of sentences about them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from service.errors import PictureError

Values = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotoFinding:
    """One thing that was found. `code` is a key of SENTENCES; `values` are what its sentence needs."""

    code: str
    values: dict[str, Any] = field(default_factory=dict)

    def sentence(self) -> str:
        return SENTENCES[self.code](self.values)

    def plain(self) -> dict[str, Any]:
        return {"code": self.code, "values": self.values, "text": self.sentence()}


class UselessPhotoError(PictureError):
    """A photograph that tells nothing. `code` is a key of REFUSALS."""

    def __init__(self, name: str, code: str, **values: Any) -> None:
        super().__init__(f"{name}: {REFUSALS[code](values)}")
        self.code = code
        self.values = values


_FORETOLD = {"finished": "as finished", "milled": "as milled", "designed": "as designed"}

REFUSALS: dict[str, Callable[[Values], str]] = {
    "no_light": lambda v: "the photograph is one tone all over; photograph the lit wall in a dark room",
    "too_dark": lambda v: (
        f"too dark: its brightest parts reach {v['peak_percent']:.2g} % of white, allowed: {v['least_percent']:g} % at "
        "least; expose longer, on a stand"
    ),
    "too_bright": lambda v: (
        f"too bright: {v['clipped_percent']:.0f} % of the picture is white and shows nothing, allowed: "
        f"{v['most_percent']:.0f} %; expose less, by one or two stops"
    ),
    "too_small": lambda v: (
        f"the lit picture is {v['across_px']:.0f} pixels wide in it, allowed: {v['least_px']:.0f} at least; "
        "go nearer, or send the photograph in full size"
    ),
    "cut_off": lambda v: (
        f"it shows {v['seen_percent']:.0f} % of the lit picture, allowed: {v['least_percent']:.0f} % at least; "
        "photograph all of it with some dark wall around"
    ),
    "not_this_lens": lambda v: (
        f"what the lens of this job should show is not in it (likeness {v['likeness']:.2f}, allowed: "
        f"{v['least']:.2f} at least); is it this job's lens, focused, in a dark room, and all of it lit?"
    ),
}  # fmt: skip


def _off(v: Values, what: str) -> str:
    return f"{v['mm']:.2g} mm (± {v['deviation_mm']:.1g} mm) {what}"


def _side(v: Values) -> str:
    return " and ".join(v["sides"])


SENTENCES: dict[str, Callable[[Values], str]] = {
    "mirrored": lambda v: (
        "the photograph shows the picture mirrored: a selfie camera does that, else the wall is looked at from the "
        f"other side than optics.viewed_from = \"{v['viewed_from']}\" says"
    ),
    "wall_too_far": lambda v: f"the wall stands {_off(v, 'too far')}: move it nearer to the lens by that much",
    "wall_too_near": lambda v: f"the wall stands {_off(v, 'too near')}: move it away from the lens by that much",
    "wall_in_place": lambda v: f"the wall's distance is right within {v['within_mm']:.2g} mm",
    "wall_unknown": lambda v: (
        f"this photograph does not tell the wall's distance to better than {v['within_mm']:.2g} mm; "
        f"check with a rule that it is {v['throw_mm']:g} mm from the top of the block"
    ),
    "wall_tilted": lambda v: (
        f"the wall leans by {v['deg']:.2g}° (± {v['deviation_deg']:.1g}°) against the block: its {_side(v)} is too far "
        "away; square the block and the wall to each other"
    ),
    "light_aslant": lambda v: (
        f"the light comes aslant by {v['deg']:.2g}° (± {v['deviation_deg']:.1g}°), towards the picture's {_side(v)}: "
        "turn the lamp, or block and wall together"
    ),
    "turned": lambda v: (
        f"the picture is turned by {abs(v['deg']):.1f}° {_way(v['deg'])} in the photograph: if the camera was level, "
        f"turn the block by that much {_way(-v['deg'])}"
    ),
    "softer": lambda v: (
        f"the light is softer than foretold {_FORETOLD[v['foretold']]}, by {v['mm']:.2g} mm on the wall (foretold "
        f"itself: {v['foretold_mm']:.2g} mm): {_why_softer(v)}"
    ),
    "sharper": lambda v: (
        f"the light is sharper than foretold {_FORETOLD[v['foretold']]}, by {v['mm']:.2g} mm on the wall: mill and "
        "finish did better than their figures say"
    ),
    "as_soft_as_foretold": lambda v: f"the light is as sharp as foretold {_FORETOLD[v['foretold']]}",
    "surface_off": lambda v: (
        f"the surface is off by {v['peak_to_valley_um']:.2g} µm from highest to lowest: {_terms(v)}"
    ),
    "surface_right": lambda v: (
        f"no long-wave error of the surface is seen (of those that can be told none is over {v['within_um']:.2g} µm)"
    ),
    "surface_unknown": lambda v: "this photograph tells nothing of long-wave errors of the surface",
    "partly_clipped": lambda v: (
        f"{v['clipped_percent']:.0f} % of the picture is white in the photograph and was left out: a shorter exposure "
        "tells more"
    ),
    "rather_dark": lambda v: "the photograph is rather dark: a longer exposure tells more",
    "odd_tones": lambda v: (
        "the camera has changed the tones (a power of "
        f"{v['tone']:.2f}): photograph without filters or HDR for surer figures"
    ),
}  # fmt: skip

_NAMES = {
    (2, 0): "bow from left to right and the other way from bottom to top",
    (1, 1): "twist",
    (3, 0): "S shape from left to right",
    (2, 1): "bow from left to right that changes from bottom to top",
    (1, 2): "bow from bottom to top that changes from left to right",
    (0, 3): "S shape from bottom to top",
    (4, 0): "W shape from left to right",
    (3, 1): "S shape from left to right that changes from bottom to top",
    (2, 2): "saddle of the corners",
    (1, 3): "S shape from bottom to top that changes from left to right",
    (0, 4): "W shape from bottom to top",
}


def _way(deg: float) -> str:
    return "clockwise" if deg > 0 else "counter-clockwise"


def _terms(v: Values) -> str:
    rows = [
        f"{_NAMES[row['order_x'], row['order_y']]} {row['um']:+.1f} µm (± {row['deviation_um']:.1f})"
        for row in v["terms"]
    ]
    return ", ".join(rows)


def _why_softer(v: Values) -> str:
    causes = [
        "the finish is not yet done" if v["foretold"] == "finished" else "mill or finish leave more than foretold",
        f"the lamp is larger (one that looks {v['source_deg']:.2g}° wide would do it)",
        "the camera was out of focus",
    ]
    return ", ".join(causes[:-1]) + ", or " + causes[-1]
