"""The light of a job. Each kind of source has its own figures; figures of another kind are errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from cam.materials import USUAL_INDEX, Material
from phrases.phrase import Phrase
from service.job.spec.section import OneOf, RuleError, Section, none_or_from, shown
from service.wording import number

if TYPE_CHECKING:
    from optics.spectrum import Spectrum

_USUAL = "collimated"
"""The kind of a light without a kind."""
SUN_DEG = 0.53
MOST_PROFILE = 128  # values along a side
_LEAST_PROFILE = 1e-6  # least maximum of a profile, so that no ratio of its values overflows
_LEFT_OUT = {"size_deg": SUN_DEG, "size_mm": 0.0}
SPECTRA = {
    "white": ("white LED", Phrase("a white LED")),
    "sun": ("sunlight", Phrase("sunlight")),
    "monochromatic": ("one wavelength", Phrase("light of one wavelength")),
}
"""By name: the choice in the form, and the name in a sentence."""
_RANGE = {
    "size_deg": Phrase("a number from 0.001 to 10 degrees"),
    "distance_mm": Phrase("a number from 10 to 100000 mm"),
    "size_mm": Phrase("a number from 0 to 1000 mm"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class LightWords:
    """Figures and texts of a kind of source; its optics are in `optics.light.LIGHT_KINDS`.

    label, hint : in the form
    figures     : keys of this kind only
    spectrum    : the default, one of SPECTRA
    is_square   : all of it comes square to the lens, whose back does not bend it
    describe    : sentence of the set-up sheet, of the light as plain data and whether it falls on a mirror
    """

    label: str
    hint: str
    describe: Callable[[Mapping[str, Any], bool], Phrase]
    figures: tuple[str, ...] = ()
    spectrum: str = "white"
    is_square: bool = False


def kind_of(light: Mapping[str, Any]) -> str:
    """Return the kind of a light given as plain data; old reports lack it."""
    return light.get("kind") or _USUAL


def describe_light(light: Mapping[str, Any], *, is_mirror: bool) -> Phrase:
    """Describe the required light for the person who sets it up; light: plain data."""
    return LIGHT_WORDS[kind_of(light)].describe(light, is_mirror)


def _describe_parallel(_light: Mapping[str, Any], is_mirror: bool) -> Phrase:
    if is_mirror:
        return Phrase("The light is parallel and comes straight onto the milled face.")
    return Phrase("The light is parallel and square to the flat back, and leaves through the milled face.")


def _describe_sun(_light: Mapping[str, Any], is_mirror: bool) -> Phrase:
    return Phrase("The light is the sun's, square to {face}: turn the lens until it is.", face=_face(is_mirror))


def _describe_lamp(light: Mapping[str, Any], is_mirror: bool) -> Phrase:
    lamp = Phrase("a small lamp")
    if size_mm := light.get("size_mm"):
        lamp = Phrase("a lamp of {diameter_mm} mm diameter", diameter_mm=number(size_mm))
    return Phrase(
        "The light is {lamp}, {distance_mm} mm from {face}, on the axis through the middle of the lens. Another "
        "distance changes size and sharpness of the picture.",
        lamp=lamp,
        distance_mm=number(light.get("distance_mm")),
        face=_face(is_mirror),
    )


def _face(is_mirror: bool) -> Phrase:
    return Phrase("the stock top (Z0), on the side of the wall") if is_mirror else Phrase("the flat back")


LIGHT_WORDS: dict[str, LightWords] = {
    _USUAL: LightWords(
        label="Parallel",
        hint="a spotlight far away, or a collimated lamp",
        describe=_describe_parallel,
        is_square=True,
    ),
    "sun": LightWords(
        label="Sun",
        hint="half a degree wide: about 1 mm of blur for every 110 mm to the wall",
        describe=_describe_sun,
        figures=("size_deg",),
        spectrum="sun",
    ),
    "point": LightWords(
        label="Lamp",
        hint="a small bright lamp close by",
        describe=_describe_lamp,
        figures=("distance_mm", "size_mm"),
    ),
}
_CHOICES = {kind: {"title": one.label, "description": one.hint} for kind, one in LIGHT_WORDS.items()}


def _when(figure: str) -> dict[str, Any]:
    return {"optics.light.kind": [kind for kind, one in LIGHT_WORDS.items() if figure in one.figures]}


class LedSpec(Section):
    """The spectrum of a coloured LED or a filter: its peak, and its full width at half the peak."""

    centre_nm: Annotated[float, Field(ge=400, le=700)]
    width_nm: Annotated[float, Field(ge=1, le=200)]


def spectrum_of(light: LightSpec) -> Spectrum:
    """Return the spectrum in the form of optics."""
    from optics.spectrum import Spectrum  # the API takes in jobs without loading optics

    if isinstance(light.spectrum, LedSpec):
        return Spectrum(kind="led", centre_nm=light.spectrum.centre_nm, width_nm=light.spectrum.width_nm)
    return Spectrum(kind=light.spectrum or "white")


def index_of(material: Material, light: LightSpec) -> float:
    """Return the material's index for the mean colour of the light; of a metal the usual one, which a mirror does not
    use.
    """
    if material.refractive_index is None:
        return USUAL_INDEX
    return round(material.refractive_index + (material.dispersion or 0.0) * spectrum_of(light).above_white, 4)


def name_spectrum(spectrum: Any) -> Phrase:
    """Return the name of a spectrum for a sentence; spectrum is plain data, None in reports without one."""
    if isinstance(spectrum, Mapping):
        return Phrase(
            "an LED of {centre_nm} nm, {width_nm} nm wide",
            centre_nm=number(spectrum["centre_nm"]),
            width_nm=number(spectrum["width_nm"]),
        )
    return SPECTRA[spectrum or "monochromatic"][1]


class LightSpec(Section):
    """The light that enters the flat face of a lens, or falls on a mirror from above.

    kind        : one of LIGHT_WORDS
    size_deg    : angular diameter of the sun
    distance_mm : of the lamp from the flat face (of a mirror: from the stock top), on the axis through the aperture
    size_mm     : diameter of the lamp
    profile     : rows of relative strength on the aperture from rim to rim, top row first, as the picture is seen
    spectrum    : a key of SPECTRA, or {centre_nm, width_nm} of a coloured LED; left out: the sun's own, otherwise white
    gaussian_mm : diameter at which a beam has fallen to 1/e^2 of its middle
    """

    kind: Annotated[str, OneOf(_CHOICES), shown("What shines on the lens", card="light", look="cards")] = _USUAL
    size_deg: Annotated[
        Annotated[float, Field(ge=0.001, le=10)] | None,
        shown("Size of the sun in the sky", card="light", usual=f"{SUN_DEG:g}", when=_when("size_deg")),
    ] = Field(default=None, validate_default=True)
    distance_mm: Annotated[
        Annotated[float, Field(ge=10, le=100_000)] | None,
        shown("Lamp to the lens", card="light", usual="needed", start="1000", when=_when("distance_mm")),
    ] = Field(default=None, validate_default=True)
    size_mm: Annotated[
        Annotated[float, Field(ge=0, le=1000), none_or_from(0.001)] | None,
        shown("Size of the lamp", "Its diameter; 0 is a point.", card="light", usual="0", when=_when("size_mm")),
    ] = Field(default=None, validate_default=True)
    spectrum: Annotated[
        Literal["white", "sun", "monochromatic"] | LedSpec | None,
        shown(
            "Colours",
            "White light spreads fine detail: acrylic bends blue more than red. A green LED is sharper.",
            choices={name: words for name, (words, _) in SPECTRA.items()},
            card="light",
            usual="of the source",
        ),
    ] = Field(default=None, validate_default=True)
    profile: list[list[float]] | None = None
    gaussian_mm: Annotated[
        Annotated[float, Field(ge=0.25, le=20_000)] | None,
        shown("Beam diameter", "Where a laser's beam has fallen to 1/e² of its middle.", usual="even light"),
    ] = None

    @property
    def figures(self) -> dict[str, Any]:
        """The figures of its kind."""
        return {name: getattr(self, name) for name in LIGHT_WORDS[self.kind].figures}

    @property
    def even(self) -> bool:
        """Whether the light is even over the aperture."""
        return self.profile is None and self.gaussian_mm is None

    @field_validator(*_RANGE)
    @classmethod
    def _of_its_kind(cls, value: float | None, info: ValidationInfo) -> float | None:
        key, kind = str(info.field_name), info.data.get("kind")
        if kind is None:  # the kind itself is wrong and has been reported
            return value
        if key not in LIGHT_WORDS[kind].figures:
            if value is not None:
                names = [f"'{name}'" for name, one in LIGHT_WORDS.items() if key in one.figures]
                raise RuleError(
                    Phrase(
                        "{value:g} is not allowed with kind = '{kind}'; it belongs to {owners}",
                        value=value,
                        kind=kind,
                        owners=reduce(lambda names, name: Phrase("{names} or {name}", names=names, name=name), names),
                    )
                )
            return None
        value = _LEFT_OUT.get(key) if value is None else value
        if value is None:
            raise RuleError(
                Phrase(
                    "is missing, a light of kind '{kind}' needs it; allowed: {allowed}", kind=kind, allowed=_RANGE[key]
                )
            )
        return value

    @field_validator("spectrum", mode="before")
    @classmethod
    def _known_spectrum(cls, spectrum: Any, info: ValidationInfo) -> Any:
        if spectrum is None:
            words = LIGHT_WORDS.get(info.data.get("kind", ""))  # none if the kind itself is wrong and has been reported
            return words.spectrum if words else "white"
        if isinstance(spectrum, str) and spectrum in SPECTRA:
            return spectrum
        try:
            return LedSpec.model_validate(spectrum)
        except ValidationError:
            raise RuleError(
                Phrase(
                    "{value} is not allowed; allowed: {names}, or centre_nm from 400 to 700 with width_nm from 1 to "
                    "200",
                    value=repr(" ".join(str(spectrum).split())[:60]),
                    names=", ".join(f"'{name}'" for name in SPECTRA),
                )
            ) from None

    @field_validator("profile", mode="before")
    @classmethod
    def _rows_of_numbers(cls, rows: Any) -> Any:
        if rows is not None and (fault := _profile_fault(rows)):
            raise RuleError(
                Phrase(
                    "{fault}; allowed: 2 to {most_rows} rows of equally many numbers, 2 to {most}, none negative, not "
                    "all 0",
                    fault=fault,
                    most_rows=MOST_PROFILE,
                    most=MOST_PROFILE,
                )
            )
        return rows

    @field_validator("gaussian_mm")
    @classmethod
    def _one_of_two(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is not None and info.data.get("profile") is not None:
            raise RuleError(Phrase("{value:g} is not allowed beside profile; allowed: one of the two", value=value))
        return value


def _profile_fault(rows: Any) -> Phrase | None:
    if not isinstance(rows, list | tuple):
        return Phrase("it is not a list of rows")
    if not 2 <= len(rows) <= MOST_PROFILE:
        return Phrase("{count} rows", count=len(rows))
    for at, row in enumerate(rows):
        if not isinstance(row, list | tuple):
            return Phrase("row {number} is not a list of numbers", number=at)
        if len(row) != len(rows[0]) or not 2 <= len(row) <= MOST_PROFILE:
            return Phrase(
                "row {number} has {count} values, row 0 has {others}", number=at, count=len(row), others=len(rows[0])
            )
        for value in row:
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= 1e12:
                return Phrase("row {number} holds {value}", number=at, value=" ".join(repr(value)[:40].split()))
    return None if max(map(max, rows)) >= _LEAST_PROFILE else Phrase("it is dark everywhere")
