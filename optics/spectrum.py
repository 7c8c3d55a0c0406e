"""The colours of a light, weighted by the eye's sensitivity, and the deviation of a material's index for each from
their mean.

A material's index follows Cauchy's law, n = A + B / wavelength^2; B follows from its dispersion n_F - n_C. So the
effect of a spectrum is the same in all materials except for that factor, and is expressed here in units of n_F - n_C.
Plain Python, for callers without arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import accumulate, pairwise
from math import exp

_F_NM, _C_NM = 486.13, 656.27
_LEAST_NM, _MOST_NM = 380, 780
_SUN_K, _SECOND_RADIATION_NM_K = 5800.0, 1.438777e7
_PER_WIDTH = 2.772589  # 4 ln 2: a Gaussian of that full width at half maximum


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """Colours of a light.

    kind     : a key of POWERS, or "monochromatic"
    centre_nm, width_nm : of "led": its peak, and its full width at half maximum
    """

    kind: str = "monochromatic"
    centre_nm: float = 0.0
    width_nm: float = 0.0

    @property
    def is_spread(self) -> bool:
        """Whether it has more than one wavelength."""
        return self.kind != "monochromatic"

    def split(self, parts: int) -> tuple[float, ...]:
        """Split the light into `parts` of equal light; return the mean index of each, ascending, minus that of the
        whole [share of n_F - n_C].
        """
        return _split(self, parts) if self.is_spread else (0.0,)

    @property
    def above_white(self) -> float:
        """The mean index minus that of a white LED's light [share of n_F - n_C]; 0 for an unnamed wavelength."""
        return _mean_share(self) - _mean_share(Spectrum(kind="white")) if self.is_spread else 0.0


def _bell(nm: float, centre_nm: float, width_nm: float) -> float:
    return exp(-_PER_WIDTH * ((nm - centre_nm) / width_nm) ** 2)


def _white_power(nm: float, _spectrum: Spectrum) -> float:
    """Return the power of a usual white LED of some 5500 K: its blue peak, and the broad band of its phosphor."""
    return _bell(nm, 450.0, 22.0) + 0.6 * _bell(nm, 560.0, 120.0)


def _sun_power(nm: float, _spectrum: Spectrum) -> float:
    """Return Planck's law, without its constant."""
    return (1000.0 / nm) ** 5 / (exp(_SECOND_RADIATION_NM_K / (nm * _SUN_K)) - 1.0)


def _led_power(nm: float, spectrum: Spectrum) -> float:
    return _bell(nm, spectrum.centre_nm, spectrum.width_nm)


POWERS: dict[str, Callable[[float, Spectrum], float]] = {
    "white": _white_power,
    "sun": _sun_power,
    "led": _led_power,
}
"""Relative power by wavelength [nm]."""


def luminous_efficiency(nm: float) -> float:
    """Return the eye's V(lambda), CIE 1924, within 0.01: Wyman, Sloan, Shirley, JCGT 2(2), 2013, two-lobe fit of y."""
    return sum(
        height * exp(-0.5 * ((nm - centre) * (rise if nm < centre else fall)) ** 2)
        for height, centre, rise, fall in ((0.821, 568.8, 0.0213, 0.0247), (0.286, 530.9, 0.0613, 0.0322))
    )


def _share(nm: float) -> float:
    """Return the index at a wavelength minus that of the longest waves [share of n_F - n_C], by Cauchy's law."""
    return nm**-2 / (_F_NM**-2 - _C_NM**-2)


def _weigh_by_eye(spectrum: Spectrum) -> list[tuple[float, float]]:
    """Return (share, light) by nanometre, in order of the index."""
    power = POWERS[spectrum.kind]
    return [(_share(nm), power(nm, spectrum) * luminous_efficiency(nm)) for nm in range(_MOST_NM, _LEAST_NM - 1, -1)]


@cache
def _mean_share(spectrum: Spectrum) -> float:
    seen = _weigh_by_eye(spectrum)
    return sum(share * light for share, light in seen) / sum(light for _, light in seen)


@cache
def _split(spectrum: Spectrum, parts: int) -> tuple[float, ...]:
    seen = _weigh_by_eye(spectrum)
    total = sum(light for _, light in seen)
    before = list(accumulate((light / total for _, light in seen), initial=0.0))
    sums = list(accumulate((share * light / total for share, light in seen), initial=0.0))
    bounds = [_between(before, sums, part / parts) for part in range(parts + 1)]
    return tuple(parts * (high - low) - sums[-1] for low, high in pairwise(bounds))


def _between(x: list[float], y: list[float], at: float) -> float:
    """Return y at `at`, interpolated linearly between ascending x."""
    k = next((k for k in range(1, len(x)) if x[k] >= at), len(x) - 1)
    step = x[k] - x[k - 1]
    return y[k] if step <= 0.0 else y[k - 1] + (y[k] - y[k - 1]) * min((at - x[k - 1]) / step, 1.0)
