"""The arrays that stages hand over, as .npz files; equal arrays make equal bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from typing import BinaryIO
from zipfile import BadZipFile

import numpy as np

from cam.surface.stock_grid import StockGrid
from optics.heightfield import Array, Heightfield
from optics.polish import Polished, PolishRecord
from phrases.phrase import Phrase
from service.errors import InputError, sentence_of_os_error


def heightfield_bytes(heightfield: Heightfield) -> bytes:
    rim = {"rim_mm": np.array(heightfield.rim_mm)} if heightfield.rim_mm else {}
    return npz_bytes({"z_mm": heightfield.z_mm, "x_mm": heightfield.x_mm, "y_mm": heightfield.y_mm, **rim})


def load_heightfield(path: Path) -> Heightfield:
    """Load a heightfield from its .npz; InputError if the file is not one."""
    arrays = load_arrays(path, ("x_mm", "y_mm", "z_mm"), optional=("rim_mm",))
    rim_mm = float(arrays.pop("rim_mm", np.zeros(())))
    try:
        heightfield = Heightfield(**arrays, rim_mm=rim_mm)
    except ValueError as error:
        raise InputError(Phrase("{path}: {cause}", path=path, cause=str(error))) from None
    if (highest_mm := float(heightfield.z_mm.max())) > 0:
        raise InputError(
            Phrase(
                "{path}: z_mm reaches {highest_mm:g} mm; allowed: 0, the stock top, and below",
                path=path,
                highest_mm=highest_mm,
            )
        )
    return heightfield


def polished_bytes(polished: Polished) -> bytes:
    record = np.array(astuple(polished.record), dtype=np.float64)
    return npz_bytes({"z_mm": polished.z_mm, "task": np.frombuffer(polished.task, np.uint8), "record": record})


def load_polished(path: Path | BinaryIO) -> Polished:
    """Load the heights of a plan's lens after its descent."""
    arrays = load_arrays(path, ("z_mm", "task", "record"))
    steps, before_db, after_db, change_um, seconds = arrays["record"].tolist()
    record = PolishRecord(
        steps=int(steps), psnr_db_before=before_db, psnr_db_after=after_db, change_um_rms=change_um, seconds=seconds
    )
    return Polished(z_mm=arrays["z_mm"], record=record, task=arrays["task"].astype(np.uint8).tobytes())


def stock_bytes(stock_top: StockGrid) -> bytes:
    place = np.array([stock_top.x0_mm, stock_top.y0_mm, stock_top.cell_mm])
    return npz_bytes({"place_mm": place, "top_mm": stock_top.top_mm})


def load_stock(path: Path) -> StockGrid:
    """Load the stock that an earlier pass has left."""
    arrays = load_arrays(path, ("place_mm", "top_mm"))
    x0_mm, y0_mm, cell_mm = (float(value) for value in arrays["place_mm"])
    return StockGrid(x0_mm=x0_mm, y0_mm=y0_mm, cell_mm=cell_mm, top_mm=arrays["top_mm"])


def picture_bytes(linear: Array) -> bytes:
    return npz_bytes({"linear": linear})


def load_picture(path: Path) -> Array:
    """Return the picture (ny, nx) in linear light, row 0 on top."""
    return load_arrays(path, ("linear",))["linear"]


def target_bytes(target: Array) -> bytes:
    return npz_bytes({"target": target})


def load_target(path: Path) -> Array:
    """Return the exact target irradiance (work frame, mean 1); map.npz also holds it, because later scores need it."""
    return load_arrays(path, ("target",))["target"]


def load_original(path: Path) -> Array | None:
    """Load the given picture from a map.npz whose target is a prepared one; None if the given picture is the target."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            if "original" not in stored:
                return None
    except (OSError, ValueError, EOFError, BadZipFile):
        pass  # reported by the code that reads the array
    return load_arrays(path, ("original",))["original"]


def npz_bytes(arrays: Mapping[str, Array]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def load_arrays(path: Path | BinaryIO, names: tuple[str, ...], optional: tuple[str, ...] = ()) -> dict[str, Array]:
    """Load those arrays of an .npz file; InputError if one is missing, or the file is not an .npz."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            there = (*names, *(name for name in optional if name in stored))
            return {name: np.asarray(stored[name], dtype=np.float64) for name in there}
    except FileNotFoundError:
        raise InputError(Phrase("{path}: there is no such file; `causticmill design` makes it", path=path)) from None
    except OSError as error:
        raise InputError(sentence_of_os_error(error, doing=Phrase("cannot read"))) from None
    except (ValueError, KeyError, EOFError, BadZipFile, AttributeError) as error:
        cause = " ".join(str(error).split())[:100]
        raise InputError(Phrase("{path}: not a file of this program ({cause})", path=path, cause=cause)) from None
