"""The forward model against an independent renderer: mitsuba's particle tracer, with its own geometry and refraction.

    pip install mitsuba      # not a dependency: 60 MB for one trial

The block is a triangle mesh of the lens with the spline's normals, a flat face, and black walls; particles leave the
lamp, are refracted twice, and are counted on a white screen by a pinhole camera before it. Two things differ by nature
and are taken out openly: what Fresnel's law reflects (a ratio of at most some percent, computed per pixel from the
angles of our own rays), and the particles' noise (two renderings with other seeds: the product of their differences to
the tubes has the systematic part as its mean, whatever the noise).

Its glass has one index, so white light is rendered wavelength by wavelength: the eye's table in place of our formula,
and Sellmeier's law in place of Cauchy's.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from scipy.optimize import brentq

from optics.bench import Bench, Branch
from optics.caustic import simulate_caustic
from optics.design import design_lens
from optics.heightfield import Heightfield
from optics.lens_settings import LensSettings
from optics.light import Beam, Light, leave, meet, strength_on_face
from optics.spectrum import POWERS, Spectrum
from optics.spline import Array
from tests.benchmarks.pictures import target
from tests.benchmarks.timing import Figure

PIXELS = 64
SIDE_MM, THROW_MM, INDEX, THICKNESS_MM = 40.0, 60.0, 1.49, 20.0
PARTICLES_PER_PIXEL = 20_000
MESH_PER_CELL = 6
ALLOWED_PERCENT = 0.5
BLACK: dict[str, Any] = {"type": "diffuse", "reflectance": 0.0}
CASES: dict[str, tuple[str, Light, Branch]] = {
    "camera, collimated": ("camera", Light(), "direct"),
    "logo, light 2 degrees aslant": ("logo", Light(tilt_rad=(math.radians(2.0), 0.0)), "direct"),
    "astronaut, point source at 150 mm": ("astronaut", Light(kind="point", distance_mm=150.0), "direct"),
    "camera, rays cross, white LED": ("camera", Light(spectrum=Spectrum(kind="white")), "inverted"),  # 7 % from mono
}
DISPERSION = 0.0085
SEEN = {  # V(lambda) of CIE 1924
    430: 0.0116, 450: 0.038, 470: 0.091, 490: 0.208, 510: 0.503, 530: 0.862, 550: 0.995, 570: 0.952, 590: 0.757,
    610: 0.503, 630: 0.265, 650: 0.107, 670: 0.032, 690: 0.0082,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Agreement:
    """Percent of the mean irradiance. systematic: noise taken out, and the floor below which noise hides it.

    seen: with the noise; level: rendered over simulated, a plain ratio
    """

    systematic: float
    floor: float
    seen: float
    level: float


def figures() -> Iterator[Figure]:
    if importlib.util.find_spec("mitsuba") is None:
        yield Figure("renderer", 0.0, "lenses", "not done: mitsuba is not installed (pip install mitsuba)")
        return
    for name, (picture, light, branch) in CASES.items():
        bench = Bench.centre_on(
            width_mm=SIDE_MM, height_mm=SIDE_MM, throw_mm=THROW_MM, refractive_index=INDEX,
            dispersion=DISPERSION, thickness_mm=THICKNESS_MM, light=light, branch=branch,
        )  # fmt: skip
        # Aslant, the lens made for straight light: its picture leaves the screen on one side.
        made_for = bench if light.kind == "point" else replace(bench, light=Light())
        lens = design_lens(target(picture, PIXELS), LensSettings(bench=made_for, skim_mm=0.1)).heightfield
        found = compare(lens, bench, PIXELS)
        words = (
            f"noise hides below {found.floor:.2f} %, with it {found.seen:.2f} %; "
            f"level {100 * found.level:.2f} % of the simulated"
        )
        if not found.systematic <= ALLOWED_PERCENT:
            words = f"BROKEN: more than {ALLOWED_PERCENT} %; {words}"
        yield Figure(f"mitsuba against tubes, {name}", found.systematic, "% RMS of the mean", words)


def compare(lens: Heightfield, bench: Bench, pixels: int, *, particles: int = PARTICLES_PER_PIXEL) -> Agreement:
    """Rendered and simulated light on a screen of the aperture's size, each in units of the light on the lens."""
    tubes = simulate_caustic(lens, bench, pixels=(pixels, pixels), tubes_per_cell=8).irradiance
    through, unit = _expected(lens, bench, pixels)
    colours = split_colours(bench)
    scenes = [(_scene(lens, replace(bench, refractive_index=index), pixels), share) for index, share in colours]
    rendered = [
        sum(share * _rendered(scene, particles // 2 // len(scenes), seed) for scene, share in scenes) / through / unit
        for seed in (1, 2)
    ]
    first, second = ((picture - tubes) / tubes.mean() for picture in rendered)
    both = first * second
    return Agreement(
        systematic=100 * math.sqrt(max(float(both.mean()), 0.0)),
        floor=100 * math.sqrt(float(both.std()) / pixels),
        seen=100 * float(np.sqrt((((first + second) / 2) ** 2).mean())),
        level=float(np.mean(rendered) / tubes.mean()),
    )


def split_colours(bench: Bench) -> list[tuple[float, float]]:
    """(index, share of the light) of each wavelength that is rendered."""
    spectrum = bench.light.spectrum
    if not spectrum.is_spread:
        return [(bench.refractive_index, 1.0)]
    nm = np.array(list(SEEN), dtype=np.float64)
    share = np.array([POWERS[spectrum.kind](one, spectrum) * seen for one, seen in SEEN.items()])
    share /= share.sum()
    f_nm, c_nm = 486.13, 656.27

    def index(at_nm: Array | float, pole_nm2: float) -> Array:
        return np.sqrt(1.0 + (INDEX**2 - 1.0) / (1.0 - pole_nm2 / np.square(at_nm)))

    pole = brentq(lambda pole: float(index(f_nm, pole) - index(c_nm, pole)) - bench.dispersion, 100.0, 40_000.0)
    indices = index(nm, pole)
    indices += bench.refractive_index - share @ indices
    return list(zip(indices.tolist(), share.tolist(), strict=True))


def _expected(lens: Heightfield, bench: Bench, pixels: int) -> tuple[Array, float]:
    """(share of each pixel's light that Fresnel's law lets through both faces, mean light on the lens).

    The latter per area of the aperture, in units of the light at the middle of the face.
    """
    side = 12 * pixels
    axis = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(axis * bench.width_mm, axis * bench.height_mm)
    jets = lens.spline().jets(x, y).reshape(6, -1)
    hit_x, hit_y, face_x, face_y, strength, passed = _rays(jets, x.ravel(), y.ravel(), bench.beam(), bench.throw_mm)
    step = bench.width_mm / side
    (xy, xx), (yy, yx) = (np.gradient(face.reshape(side, side), step) for face in (face_x, face_y))
    light = (xx * yy - xy * yx).ravel() * strength
    box = ((0.0, bench.height_mm), (0.0, bench.width_mm))
    came, went = (np.histogram2d(hit_y, hit_x, bins=pixels, range=box, weights=w)[0] for w in (light, light * passed))
    share = np.where(came > 0, went / np.where(came > 0, came, 1.0), (light * passed).sum() / light.sum())
    return share, float(light.mean()) * _light_at_face(bench)


@njit
def _rays(jets: Array, x: Array, y: Array, beam: Beam, throw: float) -> Array:
    """(6, n): arrival x, y; face x, y; strength there; share that Fresnel's law lets through."""
    out, n = np.empty((6, x.size)), beam.refractive_index
    for k in range(x.size):
        z, zx, zy = jets[0, k], jets[1, k], jets[2, k]
        dx, dy, dz, _, face_x, face_y = meet(beam, x[k], y[k], z)
        tx, ty, tz = leave(dx, dy, dz, zx, zy, n, False)
        norm = math.sqrt(1 + zx * zx + zy * zy)
        cos_in, cos_out = (dz - zx * dx - zy * dy) / norm, (tz - zx * tx - zy * ty) / norm
        out[0, k], out[1, k] = x[k] + (throw - z) / tz * tx, y[k] + (throw - z) / tz * ty
        out[2, k], out[3, k], out[4, k] = face_x, face_y, strength_on_face(beam, face_x, face_y)
        cos_air = math.sqrt(1 - n * n * (dx * dx + dy * dy))
        out[5, k] = _let_through(cos_air, dz, 1 / n) * _let_through(cos_in, cos_out, n)
    return out


@njit
def _let_through(cos_in: float, cos_out: float, index: float) -> float:
    """Fresnel's transmittance of unpolarised light; index: before over behind."""
    across = (index * cos_in - cos_out) / (index * cos_in + cos_out)
    within = (index * cos_out - cos_in) / (index * cos_out + cos_in)
    return 1 - (across * across + within * within) / 2


def _light_at_face(bench: Bench) -> float:
    """Of a lamp of intensity 1, or of light of irradiance 1 across its own direction."""
    light = bench.light
    if light.kind == "point":
        return light.distance_mm**-2
    return 1 / math.sqrt(1 + sum(math.tan(angle) ** 2 for angle in light.tilt_rad))


def _rendered(scene: Any, particles_per_pixel: int, seed: int) -> Array:
    """Irradiance (ny, nx), row 0 at the lowest y; white scatters 1 / pi of it towards the camera."""
    import mitsuba as mi

    picture = np.array(mi.render(scene, spp=particles_per_pixel, seed=seed), dtype=np.float64)
    return np.asarray(picture[::-1, ::-1, 0] * math.pi)


def _scene(lens: Heightfield, bench: Bench, pixels: int) -> Any:
    """The block from its rim's rays inwards, the lamp beneath, the screen, and a pinhole camera in between."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")  # the others want an LLVM or a GPU of the right kind
    mi.logger().clear_appenders()  # its progress bars
    at, middle, face = mi.ScalarTransform4f, bench.width_mm / 2, -bench.thickness_mm
    glass = {"type": "dielectric", "int_ior": bench.refractive_index, "ext_ior": 1.0}
    upside_down = at().rotate([1, 0, 0], 180)
    foot, rim = _rim(lens, bench.beam())
    out = np.array([middle, middle, face]) + 1.5 * (foot - [middle, middle, face])
    camera = at().look_at(origin=[middle, middle, 0.5], target=[middle, middle, bench.throw_mm], up=[0, 1, 0])
    angle = 2 * math.degrees(math.atan(middle / (bench.throw_mm - 0.5)))
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "pixel_format": "luminance"}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "ptracer", "max_depth": 4, "rr_depth": 100},  # no light that was reflected inside
        "lens": _lens_mesh(lens, glass),
        "face": {
            "type": "rectangle",
            "to_world": at().translate([middle, middle, face]) @ upside_down @ at().scale(2 * middle),
            "bsdf": glass,
        },
        "walls": _strip("walls", foot, rim),
        "plate": _strip("plate", foot - [0, 0, 1e-3], out - [0, 0, 1e-3]),
        "screen": {
            "type": "rectangle",
            "to_world": at().translate([middle, middle, bench.throw_mm]) @ upside_down @ at().scale(middle),
            "bsdf": {"type": "diffuse", "reflectance": 1.0},
        },
        "lamp": _lamp(bench),
        "camera": {
            "type": "perspective",
            "fov": angle,
            "to_world": camera,
            "film": film | {"rfilter": {"type": "box"}, "component_format": "float32"},
            "sampler": {"type": "independent"},
        },
    })  # fmt: skip


def _lamp(bench: Bench) -> dict[str, Any]:
    import mitsuba as mi

    at, middle, light = mi.ScalarTransform4f, bench.width_mm / 2, bench.light
    tan_x, tan_y = (math.tan(angle) for angle in light.tilt_rad)
    away = light.distance_mm if light.kind == "point" else 3.0
    place = np.array([middle - away * tan_x, middle - away * tan_y, -bench.thickness_mm - away])
    to_world = at().look_at(origin=place, target=place + np.array([tan_x, tan_y, 1.0]), up=[0, 1, 0])
    if light.kind == "point":
        wide = math.degrees(math.atan(1.05 * math.sqrt(2) * middle / away))
        return {
            "type": "spot",
            "to_world": to_world,
            "intensity": 1.0,
            "cutoff_angle": wide,
            "beam_width": 0.999 * wide,
        }
    shape = {"type": "rectangle", "to_world": to_world @ at().scale(middle + 2), "bsdf": BLACK}
    return shape | {"emitter": {"type": "directionalarea", "radiance": 1.0}}


def _lens_mesh(lens: Heightfield, glass: dict[str, Any]) -> Any:
    """The lens surface, MESH_PER_CELL x MESH_PER_CELL x 2 triangles a cell, with the spline's own normals."""
    x, y = (np.linspace(axis[0], axis[-1], (axis.size - 1) * MESH_PER_CELL + 1) for axis in (lens.x_mm, lens.y_mm))
    z, zx, zy = lens.spline().jets(*np.meshgrid(x, y))[:3]
    points = np.stack([*np.meshgrid(x, y), z], axis=-1)
    normals = np.stack([-zx, -zy, np.ones_like(z)], axis=-1) / np.sqrt(1 + zx**2 + zy**2)[..., None]
    return _mesh("lens", points, glass, normals)


def _rim(lens: Heightfield, beam: Beam) -> tuple[Array, Array]:
    """(foot, rim) (k, 3): the lens's rim as a closed line, and where its rays crossed the face."""
    x, y, spline = lens.x_mm, lens.y_mm, lens.spline()
    along = (
        [(a, y[0]) for a in x] + [(x[-1], b) for b in y] + [(a, y[-1]) for a in x[::-1]] + [(x[0], b) for b in y[::-1]]
    )
    rim = np.array([(a, b, float(spline.heights_mm(a, b))) for a, b in along])
    foot = np.array([(*meet(beam, *point)[4:], beam.face) for point in rim])
    return foot, rim


def _strip(name: str, low: Array, high: Array) -> Any:
    return _mesh(name, np.stack([low, high]), BLACK)


def _mesh(name: str, points: Array, bsdf: dict[str, Any], normals: Array | None = None) -> Any:
    """A grid of points (rows, columns, 3) as two triangles a cell."""
    import mitsuba as mi

    rows, columns = points.shape[:2]
    number = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.stack([np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)])
    how = mi.Properties()
    how["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, rows * columns, faces.size // 3, has_vertex_normals=normals is not None, props=how)
    values = mi.traverse(mesh)
    values["vertex_positions"] = points.astype(np.float32).ravel()
    values["faces"] = faces.ravel()
    if normals is not None:
        values["vertex_normals"] = normals.astype(np.float32).ravel()
    values.update()
    return mesh
