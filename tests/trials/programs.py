"""Programs for the trials, made as they are read: short finishing lines whose every end point is known by number."""

from __future__ import annotations

from collections.abc import Iterator

from machines.driver import ProgramLine

PREAMBLE = (b"G21G90G94G17G54", b"M3S12000", b"G0X0Y0Z5", b"G0X0Y0Z1", b"G1Z-1.5F3000")
_ROW = 2000  # points in one row; rows are 0.02 mm apart, and every second one runs back
_STEP_UM = 50


def point_um(k: int) -> tuple[int, int, int]:
    """End of the k-th cut (from 0) in micrometres: a raster over shallow waves of z."""
    row, column = divmod(k, _ROW)
    x = (column if row % 2 == 0 else _ROW - 1 - column) * _STEP_UM
    z = -1000 - (k * 7919 % 41)
    return x, row % 5000 * 20, z


def block(k: int) -> bytes:
    """The k-th cut as text, only the words that a finishing pass would print."""
    x, y, z = point_um(k)
    if k % _ROW == 0:
        return b"X%d.%03dY%d.%03dZ-%d.%03d" % (*divmod(x, 1000), *divmod(y, 1000), *divmod(-z, 1000))
    return b"X%d.%03dZ-%d.%03d" % (*divmod(x, 1000), *divmod(-z, 1000))


def padded(text: bytes, length: int) -> bytes:
    """The same block with as many zeros after its last decimal as make it `length` bytes with its line end."""
    return text + b"0" * (length - 1 - len(text))


def lines(count: int, *, line_bytes: int | None = None) -> Iterator[ProgramLine]:
    """PREAMBLE, `count` cuts, M5 and M2."""
    offset = 0
    number = 0

    def numbered(text: bytes) -> ProgramLine:
        nonlocal offset, number
        number += 1
        line = ProgramLine(number, offset, text)
        offset += len(text) + 1
        return line

    for text in PREAMBLE:
        yield numbered(text)
    for k in range(count):
        text = block(k)
        yield numbered(text if line_bytes is None else padded(text, line_bytes))
    yield numbered(b"G0Z5")
    yield numbered(b"M5")
    yield numbered(b"M2")


def waves_mm(cuts: int) -> list[tuple[float, float, float]]:
    """Where so many cuts begin and end: rows of shallow waves, 0.3 mm a move."""
    points = [(1.0, 1.0, -1.0)]
    for k in range(cuts):
        row, column = divmod(k + 1, 50)
        x = 1.0 + 0.3 * (column if row % 2 == 0 else 49 - column)
        points.append((round(x, 3), round(1.0 + 0.25 * row, 3), round(-1.0 - 0.013 * (k * 37 % 11), 3)))
    return points
