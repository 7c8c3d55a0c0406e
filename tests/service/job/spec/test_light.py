"""The colours of a light in a spec, and the index of the block for them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cam.materials import PMMA
from optics.spectrum import Spectrum
from service.job.spec.lens_task import bench_of, facts_of_light
from service.job.spec.light import LedSpec, LightSpec, index_of, name_spectrum
from service.job.spec.loading import reduce_spec, resolve_job
from service.job.spec.model import JobSpec


def resolved(*overrides: str) -> JobSpec:
    return resolve_job(overrides=list(overrides)).spec


@pytest.mark.parametrize(
    ("override", "spectrum"),
    [
        ((), Spectrum(kind="white")),
        (("optics.light.kind=sun",), Spectrum(kind="sun")),
        (("optics.light.kind=sun", "optics.light.spectrum=monochromatic"), Spectrum()),
        (("optics.light.spectrum=monochromatic",), Spectrum()),
        (
            ("optics.light.spectrum={centre_nm=530, width_nm=35}",),
            Spectrum(kind="led", centre_nm=530.0, width_nm=35.0),
        ),
        (
            ("optics.light.spectrum.centre_nm=530", "optics.light.spectrum.width_nm=35"),
            Spectrum(kind="led", centre_nm=530.0, width_nm=35.0),
        ),
    ],
)
def test_the_colours_of_a_job_reach_its_bench(override: tuple[str, ...], spectrum: Spectrum) -> None:
    spec = resolved(*override)
    bench = bench_of(spec)
    assert (bench.light.spectrum, bench.dispersion) == (spectrum, PMMA.dispersion)
    assert resolve_job(overrides=[], base=reduce_spec(spec.plain())).spec == spec


def test_the_index_is_that_of_the_light_s_mean_colour() -> None:
    """1.49 in white; in green higher, in blue more so, in red lower; a person's own stays."""
    index = {
        nm: resolved(f"optics.light.spectrum={{centre_nm={nm}, width_nm=20}}").optics.refractive_index
        for nm in (450, 530, 630)
    }
    assert index[630] < 1.49 < index[530] < index[450]
    assert index[530] == pytest.approx(1.4913, abs=2e-4)
    assert resolved().optics.refractive_index == resolved("optics.light.spectrum=monochromatic").optics.refractive_index
    own = resolved("optics.light.spectrum={centre_nm=450, width_nm=20}", "optics.refractive_index=1.5")
    assert own.optics.refractive_index == 1.5


@given(st.floats(400.0, 700.0), st.floats(1.0, 200.0))
def test_a_material_of_unknown_dispersion_has_one_index(centre_nm: float, width_nm: float) -> None:
    unknown = replace(PMMA, dispersion=None)
    light = LightSpec(spectrum=LedSpec(centre_nm=centre_nm, width_nm=width_nm))
    assert index_of(unknown, light) == PMMA.refractive_index


@pytest.mark.parametrize(
    ("override", "facts", "words"),
    [
        ((), {"kind": "collimated", "spectrum": "white", "dispersion": 0.0085}, "a white LED"),
        (
            ("optics.light.kind=sun", "optics.surface=mirror"),
            {"kind": "sun", "size_deg": 0.53, "spectrum": "sun", "dispersion": 0.0},
            "sunlight",
        ),
        (
            ("optics.light.spectrum={centre_nm=530, width_nm=35}", "optics.light.profile=[[1.0, 2.0], [1.0, 2.0]]"),
            {
                "kind": "collimated",
                "spectrum": {"centre_nm": 530.0, "width_nm": 35.0},
                "dispersion": 0.0085,
            },
            "an LED of 530 nm, 35 nm wide",
        ),
    ],
)
def test_scores_state_their_light(override: tuple[str, ...], facts: dict[str, Any], words: str) -> None:
    found = facts_of_light(resolved(*override))
    assert found == {**facts, "words": words}
    assert str(name_spectrum(found["spectrum"])) == words
