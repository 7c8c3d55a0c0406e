"""Pictures, lenses and their light for docs/paper.md: each computed once per run."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from optics.bench import Bench
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.irradiance import picture_from_irradiance, target_irradiance
from optics.lens_settings import LensSettings
from optics.metrics import CausticScore, score_caustic
from optics.paper.flow import FlowSettings, PaperFlow, pixel_vertices, project_to_frame
from optics.paper.flow_rules import face_intensities
from optics.paper.mesh import TriangleMesh
from optics.paper.poisson import NeumannPoisson
from optics.paper.surface import PaperLens, paper_lens

EXAMPLES = Path(__file__).parents[2] / "examples"
SIDE_MM = THROW_MM = 100.0
INDEX = 1.49


def setting(side_mm: float) -> LensSettings:
    """The paper's set-up, all of it as many times smaller as the lens is."""
    throw_mm = side_mm * THROW_MM / SIDE_MM
    bench = Bench.centre_on(width_mm=side_mm, height_mm=side_mm, throw_mm=throw_mm, refractive_index=INDEX)
    return LensSettings(bench=bench, skim_mm=0.1)


SETTING = setting(SIDE_MM)
WAYS = {"none": "the paper's section 4", "simple": "its section 5: darts", "clean": "ours: even grids"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """A lens, its light and its score. `contrast`: slope of the light against the target, 1 where it is all there."""

    heightfield: Heightfield
    light: np.ndarray
    score: CausticScore
    contrast: float
    cpu_s: float
    flow: PaperFlow | None = None
    surface: PaperLens | None = None


@cache
def target(name: str, pixels: int) -> np.ndarray:
    """An example picture, averaged to pixels x pixels, as the viewer behind the screen sees it.

    Decoded from sRGB, or its grey values taken for light as they are: "camera, undecoded".
    """
    if name == "slanted edge":
        return slanted_edge(pixels)
    file, _, tone = name.partition(", ")
    grey = np.asarray(Image.open(EXAMPLES / f"{file}.png").convert("L"), dtype=np.float64) / 255
    decoded = np.where(grey <= 0.04045, grey / 12.92, ((grey + 0.055) / 1.055) ** 2.4)
    linear = (grey if tone == "undecoded" else decoded).astype(np.float32)
    sized = np.asarray(Image.fromarray(linear).resize((pixels, pixels), Image.Resampling.BOX), dtype=np.float64)
    return target_irradiance(np.clip(sized, 0.0, None), viewed_from="behind")


def slanted_edge(pixels: int, fine: int = 8) -> np.ndarray:
    """A bright band with two straight edges, off the grid by atan(1/4), on a ground of a twentieth; mean 1."""
    y, x = (np.mgrid[: pixels * fine, : pixels * fine] + 0.5) / (pixels * fine)
    bright = np.abs(x - 0.5 + 0.25 * (y - 0.5)) < 0.16
    picture = np.where(bright, 1.0, 0.05).reshape(pixels, fine, pixels, fine).mean(axis=(1, 3))
    return picture / picture.mean()


def edge_waviness_pixels(light: np.ndarray) -> float:
    """RMS distance along x of the light's half-way crossings from the straight edges of `slanted_edge`, per edge."""
    pixels = light.shape[0]
    misses = []
    for row in range(pixels // 8, pixels - pixels // 8):
        middle = pixels * (0.5 - 0.25 * ((row + 0.5) / pixels - 0.5))
        half = (light[row].max() + light[row].min()) / 2
        half = min(half, 0.5 * (np.percentile(light[row], 90) + np.percentile(light[row], 10)))
        for side in (-1, 1):
            edge = middle + side * 0.16 * pixels
            near = np.arange(int(edge) - 6, int(edge) + 7)
            values = light[row, near][::-side]  # falling outward becomes rising
            centres = (near + 0.5)[::-side]
            above = np.flatnonzero((values[:-1] < half) & (values[1:] >= half))
            if above.size:
                k = above[np.abs(centres[above] - edge).argmin()]
                share = (half - values[k]) / (values[k + 1] - values[k])
                misses.append((side, centres[k] + share * (centres[k + 1] - centres[k]) - edge))
    sides = [np.array([miss for side, miss in misses if side == which]) for which in (-1, 1)]
    return float(np.sqrt(np.mean([np.var(values) for values in sides])))


def contrast_reached(light: np.ndarray, wanted: np.ndarray) -> float:
    return float(np.sum((light - light.mean()) * (wanted - wanted.mean())) / np.sum((wanted - wanted.mean()) ** 2))


@cache
def by_the_paper(name: str, pixels: int, remeshing: str) -> Result:
    wanted = target(name, pixels)
    started = time.process_time()
    lens = paper_lens(wanted, SETTING, flow_settings=FlowSettings(remeshing=remeshing))
    cpu_s = time.process_time() - started
    light = seen(lens.heightfield, pixels)
    return Result(
        heightfield=lens.heightfield,
        light=light,
        score=score_caustic(light, wanted),
        contrast=contrast_reached(light, wanted),
        cpu_s=cpu_s,
        flow=lens.flow,
        surface=lens,
    )


@cache
def by_transport(name: str, pixels: int, side_mm: float = SIDE_MM) -> Result:
    wanted, made_for = target(name, pixels), setting(side_mm)
    started = time.process_time()
    design = design_lens(wanted, made_for)
    cpu_s = time.process_time() - started
    light = simulate_caustic(design.heightfield, made_for.bench, pixels=(pixels, pixels)).irradiance
    return Result(
        heightfield=design.heightfield,
        light=light,
        score=score_caustic(light, wanted),
        contrast=contrast_reached(light, wanted),
        cpu_s=cpu_s,
    )


def first_step(name: str, pixels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the first step sees: D (n, n), phi (n, n) [mm^2], grad phi (n, n, 2) [mm]."""
    vertices = pixel_vertices(pixels, SIDE_MM)
    mesh, shape = TriangleMesh.build_regular(vertices, vertices), (pixels, pixels)
    faces = mesh.dual_areas()
    wanted, _ = face_intensities(target(name, pixels), faces, FlowSettings().floor)
    phi = NeumannPoisson(mesh).solve(mesh, (1.0 - wanted) * faces, tolerance=1e-6).values
    velocity = project_to_frame(mesh.vertex_gradients(phi, mesh.areas()), shape)
    return (1.0 - wanted).reshape(shape), phi.reshape(shape), velocity.reshape(*shape, 2)


def slope_rms_mrad(result: Result) -> float:
    """Of the surface."""
    steep = np.gradient(result.heightfield.z_mm, result.heightfield.dy_mm, result.heightfield.dx_mm)
    return 1e3 * float(np.sqrt(np.mean(steep[0] ** 2 + steep[1] ** 2)))


def seen(heightfield: Heightfield, pixels: int, throw_mm: float = THROW_MM) -> np.ndarray:
    """The light on a screen of the lens's size, throw_mm above Z0."""
    bench = replace(SETTING.bench, throw_mm=throw_mm)
    return simulate_caustic(heightfield, bench, pixels=(pixels, pixels)).irradiance


def as_picture(light: np.ndarray, peak: float) -> np.ndarray:
    """8 bit grey, row 0 on top, sRGB, the target's peak at white."""
    linear = np.clip(picture_from_irradiance(light, viewed_from="behind") / peak, 0.0, 1.0)
    grey = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (255 * grey + 0.5).astype(np.uint8)
