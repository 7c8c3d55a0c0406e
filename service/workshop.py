"""What the stages of a job share: its spec, the folder they work in, the report they fill, the clock; and the arrays
they store for one another."""

from __future__ import annotations

import io
import platform
import resource
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal
from zipfile import BadZipFile

import numpy as np

from optics.design import LensSettings
from optics.heightfield import Array, Heightfield
from optics.transport_map import TransportMap
from service import job_files
from service.errors import InputError, sentence_of_os_error
from service.progress import Stopwatch
from service.spec import JobSpec

Part = Literal["optics", "passes"]


@dataclass(frozen=True, kw_only=True)
class Workshop:
    """One running command. `report` becomes report.json; `notes` are the warnings found so far, by part of the job."""

    spec: JobSpec
    folder: Path
    watch: Stopwatch
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[Part, list[str]] = field(default_factory=lambda: {"optics": [], "passes": []})

    def note(self, part: Part, sentence: str) -> None:
        if sentence not in self.notes[part]:
            self.notes[part].append(sentence)

    @property
    def warnings(self) -> list[str]:
        return [*self.notes["optics"], *self.notes["passes"]]

    def save(self, name: str, data: bytes) -> None:
        job_files.write_bytes(self.folder / name, data)


def lens_settings(spec: JobSpec) -> LensSettings:
    """The optical task of a job."""
    optics = spec.optics
    screen_width_mm, screen_height_mm = optics.screen_size_mm
    return LensSettings(
        width_mm=optics.width_mm,
        height_mm=optics.height_mm,
        throw_mm=optics.throw_mm,
        refractive_index=optics.refractive_index,
        screen_width_mm=screen_width_mm,
        screen_height_mm=screen_height_mm,
        skim_mm=spec.stock.skim_mm,
        method=optics.method,
        corrections=optics.corrections,
        min_radius_mm=optics.min_radius_mm,
    )


def save_heightfield(folder: Path, heightfield: Heightfield) -> None:
    arrays = {"z_mm": heightfield.z_mm, "x_mm": heightfield.x_mm, "y_mm": heightfield.y_mm}
    job_files.write_bytes(folder / job_files.HEIGHTFIELD, npz_bytes(arrays))


def save_map(folder: Path, transport_map: TransportMap, target: Array) -> None:
    """The map, and beside it the exact target irradiance (work frame, mean 1) that scores need again later."""
    arrays = {"screen_mm": transport_map.screen_mm, "lens_mm": transport_map.lens_mm, "target": target}
    job_files.write_bytes(folder / job_files.MAP, npz_bytes(arrays))


def load_heightfield(path: Path) -> Heightfield:
    """A heightfield from its .npz; InputError where the file is none."""
    arrays = _load(path, ("x_mm", "y_mm", "z_mm"))
    try:
        heightfield = Heightfield(**arrays)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if (highest_mm := float(heightfield.z_mm.max())) > 0:
        raise InputError(f"{path}: z_mm reaches {highest_mm:g} mm; allowed: 0, the stock top, and below")
    return heightfield


def load_target(folder: Path) -> Array:
    """The target irradiance of a designed lens."""
    return _load(folder / job_files.MAP, ("target",))["target"]


def npz_bytes(arrays: Mapping[str, Array]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def _load(path: Path, names: tuple[str, ...]) -> dict[str, Array]:
    try:
        with np.load(path, allow_pickle=False) as stored:
            return {name: np.asarray(stored[name], dtype=np.float64) for name in names}
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; `causticmill design` makes it") from None
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing="cannot read")) from None
    except (ValueError, KeyError, EOFError, BadZipFile, AttributeError) as error:
        raise InputError(f"{path}: not a file of this program ({' '.join(str(error).split())[:100]})") from None


def versions() -> dict[str, str]:
    """Versions of this program and of what its numbers depend on."""
    names = ("causticmill", "numpy", "scipy", "numba", "pillow")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def peak_rss_mb() -> float:
    """The largest memory this process has held, in MB (the unit of ru_maxrss is bytes on macOS, else KiB)."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak * (1 if sys.platform == "darwin" else 1024) / 1e6, 1)
