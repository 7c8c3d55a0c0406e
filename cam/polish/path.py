"""The path of a polishing bob: over every node of a lattice once a round, in no preferred direction.

Theory of operation. A spanning tree of random weights joins the cells of a coarse lattice. The way around the tree,
which is on its left, passes the four fine nodes of each cell once: a closed path without crossings that turns at random
(Hamiltonian cycle). Corners are quarter circles of half the pitch, so the path has no corner sharper than a chord of
one. Each round has another tree; all begin in the corner of the same cell, where one goes on from the one before.

The tip follows the surface of a ball that is smaller by the compression: its centre is that deep below where the bob
would just touch, along the normal. A node's dwell is the length of its piece of path over its feed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from cam.errors import PassValueError, SafeHeightError
from cam.moves import RAPID_CLEARANCE_MM, Array, Path, cut, rapid
from cam.passes import Stock
from cam.rows.entries import leave
from cam.surface.tool_surface import ToolSurface
from optics.heightfield import Heightfield
from phrases.phrase import Phrase

_CHORDS = 3  # of a quarter circle
_FEED_STEP = 1.02  # ratio of two neighbouring feeds: fewer words, and dwell is right within a percent
_SLOWEST_MM_PER_MIN = 5.0
_BRAKE_SHARE = 0.5  # of the axes' acceleration, that a quarter circle takes
_BEYOND = 1.5  # contact radii beyond the rim that the bob's contact point goes


@dataclass(frozen=True, slots=True, kw_only=True)
class PolishCut:
    """A bob's work: a soft ball pressed into the lens by a constant depth along the normal.

    contact_mm          : radius of its contact on a flat
    pitch_mm            : distance of neighbouring tracks
    most_mm_per_s       : surface speed that heat allows
    acceleration_mm_per_s2, max_rate_mm_per_min : of the axes X, Y, Z, which feeds keep to
    """

    radius_mm: float
    compression_mm: float
    contact_mm: float
    pitch_mm: float
    plunge_mm_per_min: float
    spindle_rpm: float
    most_mm_per_s: float
    acceleration_mm_per_s2: tuple[float, float, float]
    max_rate_mm_per_min: tuple[float, float, float]

    def __post_init__(self) -> None:
        for name in ("radius_mm", "compression_mm", "contact_mm", "pitch_mm", "plunge_mm_per_min", "spindle_rpm"):
            if not 0 < (value := getattr(self, name)) < math.inf:
                raise PassValueError(name=name, value=value, allowed=Phrase("above {least:g}", least=0))
        if self.compression_mm > self.radius_mm / 4:
            allowed = Phrase("at most a quarter of the bob's radius, {most_mm:g} mm", most_mm=self.radius_mm / 4)
            raise PassValueError(name="compression_mm", value=self.compression_mm, allowed=allowed)

    @property
    def most_feed_mm_per_min(self) -> float:
        """The feed at which quarter circles take half of what the axes can accelerate."""
        by_turns = 60 * math.sqrt(_BRAKE_SHARE * min(self.acceleration_mm_per_s2[:2]) * self.pitch_mm / 2)
        return min(by_turns, *self.max_rate_mm_per_min)

    @property
    def most_reach_mm(self) -> float:
        """How far outside the aperture its axis may have to go."""
        return self.radius_mm + _BEYOND * self.contact_mm

    def surface_over(self, lens: Heightfield) -> ToolSurface:
        """Return the surface of its tips over the lens."""
        reach = self.most_reach_mm + 2 * self.pitch_mm
        return ToolSurface.over(lens, radius_mm=self.radius_mm, allowance_mm=-self.compression_mm, run_out_mm=reach)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lattice:
    """The nodes of the path: cell (j, i) of the coarse lattice holds the fine nodes 2 j .. 2 j + 1, 2 i .. 2 i + 1.

    x_mm (nx,), y_mm (ny,)     : of the fine nodes
    cells (ny / 2, nx / 2)     : which the path visits, all connected
    at_mm, tip_mm (ny, nx, ..) : contact point (2) and tip (3) at each fine node
    """

    x_mm: Array
    y_mm: Array
    cells: np.ndarray
    at_mm: Array
    tip_mm: Array

    @property
    def nodes(self) -> np.ndarray:
        """(ny, nx) of bool: fine nodes that the path visits."""
        return np.repeat(np.repeat(self.cells, 2, axis=0), 2, axis=1)


def lay_lattice(surface: ToolSurface, stock: Stock, task: PolishCut) -> Lattice:
    """Return the lattice whose contact points cover the aperture and one and a half contact radii around it."""
    beyond, reach = _BEYOND * task.contact_mm, task.most_reach_mm
    x, y = (_even_nodes(-reach, size + reach, task.pitch_mm) for size in (stock.width_mm, stock.height_mm))
    rows = np.array([surface.contacts_mm(x, np.full_like(x, row)) for row in y])
    at = rows[:, :, :2]
    size = np.array([stock.width_mm, stock.height_mm])
    near = ((at >= -beyond) & (at <= size + beyond)).all(axis=2)
    cells = near.reshape(y.size // 2, 2, x.size // 2, 2).any(axis=(1, 3))
    grid = np.broadcast_arrays(x[None, :], y[:, None])
    return Lattice(x_mm=x, y_mm=y, cells=_largest_part(cells), at_mm=at, tip_mm=np.dstack([*grid, rows[:, :, 2]]))


def list_dwells(lattice: Lattice, dwell_s: Array) -> Array:
    """Return (ny, nx) of dwell (n,) at the visited nodes in order; 0 elsewhere."""
    out = np.zeros(lattice.nodes.shape)
    out[lattice.nodes] = dwell_s
    return out


def count_rounds(lattice: Lattice, dwell_s: Array, task: PolishCut) -> int:
    """Return the number of rounds in which the dwell (ny, nx) of all of them can be spent within the greatest feed.

    PassValueError: not even in one: the bob takes off too much.
    """
    least_s = 60 * task.pitch_mm / task.most_feed_mm_per_min
    shortest_s = float(np.quantile(dwell_s[lattice.nodes], 0.002))
    if shortest_s < least_s:
        raise PassValueError(
            name="spindle_rpm",
            value=task.spindle_rpm,
            allowed=Phrase(
                "at most {most_rpm:.0f} rpm: at the greatest feed, F{feed_mm_per_min:.0f}, one round of the bob takes "
                "off {times:.2g} times what is planned; or more minutes, or a softer bob",
                most_rpm=task.spindle_rpm * shortest_s / least_s,
                feed_mm_per_min=task.most_feed_mm_per_min,
                times=least_s / shortest_s,
            ),
        )
    return int(shortest_s / least_s)


def polish_paths(
    surface: ToolSurface,
    lattice: Lattice,
    dwell_s: Array,
    task: PolishCut,
    *,
    rounds: int,
    top_mm: float,
    safe_z_mm: float,
) -> Iterator[Path]:
    """Yield the tip's moves, which begin and end at safe height.

    dwell_s (ny, nx) : of all rounds together; top_mm: of the highest stock
    """
    over_mm = max(top_mm, 0.0) + RAPID_CLEARANCE_MM
    if safe_z_mm < over_mm:
        raise SafeHeightError(safe_z_mm=safe_z_mm, needed_mm=over_mm)
    place: Array | None = None
    for number in range(rounds):
        after = _follow_tree(lattice.cells, np.random.default_rng(number))
        nodes = _number_nodes(_walk(after, int(np.flatnonzero(lattice.cells)[0])), lattice.cells.shape[1])
        pieces, owner = _round_corners(nodes, lattice, task.pitch_mm)
        points = np.column_stack([pieces, surface.tip_heights_mm(pieces[:, 0], pieces[:, 1])])
        if place is None:
            place = points[-1]
            yield rapid((place[0], place[1], safe_z_mm), (place[0], place[1], over_mm))
            yield cut([place], task.plunge_mm_per_min)
        yield from _with_feeds(place, points, owner, dwell_s.ravel()[nodes] / rounds, task)
        place = points[-1]
    assert place is not None
    yield leave(float(place[0]), float(place[1]), safe_z_mm=safe_z_mm)


def _with_feeds(place: Array, points: Array, owner: np.ndarray, dwell_s: Array, task: PolishCut) -> Iterator[Path]:
    """Yield the pieces of each node at the feed that spends its dwell, neighbours of like feed together."""
    lengths = np.linalg.norm(np.diff(np.vstack([place, points]), axis=0), axis=1)
    along = np.bincount(owner, lengths, minlength=dwell_s.size)
    feed = 60 * along / np.maximum(dwell_s, 1e-9)
    levels = np.rint(np.log(np.clip(feed, _SLOWEST_MM_PER_MIN, task.most_feed_mm_per_min)) / math.log(_FEED_STEP))
    level = levels[owner]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(level)) + 1, [len(points)]]).astype(int)
    for begin, end in pairwise(begins):
        yield cut(points[begin:end], round(float(_FEED_STEP ** level[begin]), 1))


def _even_nodes(low: float, high: float, pitch: float) -> Array:
    count = 2 * math.ceil((high - low) / (2 * pitch))
    return (low + high) / 2 + pitch * (np.arange(count) - (count - 1) / 2)


def _largest_part(cells: np.ndarray) -> np.ndarray:
    """Return the largest connected part of cells (ny, nx)."""
    a, b = _neighbours(cells)
    graph = coo_array((np.ones(a.size), (a, b)), shape=(cells.size, cells.size))
    label = connected_components(graph, directed=False)[1].reshape(cells.shape)
    return np.asarray(cells & (label == np.bincount(label[cells]).argmax()))


def _neighbours(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of neighbouring cells, by their flat numbers; the second is right of the first, or above it."""
    number = np.arange(cells.size).reshape(cells.shape)
    right, up = cells[:, :-1] & cells[:, 1:], cells[:-1] & cells[1:]
    return (
        np.concatenate([number[:, :-1][right], number[:-1][up]]),
        np.concatenate([number[:, 1:][right], number[1:][up]]),
    )


def _follow_tree(cells: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return (4 cells.size,) the next node of each on the way around a random tree; node 4 c + q of cell c, q = 0 .. 3:
    lower left, lower right, upper right, upper left.
    """
    a, b = _neighbours(cells)
    graph = coo_array((1.0 + random.random(a.size), (a, b)), shape=(cells.size, cells.size))
    tree = minimum_spanning_tree(graph.tocsr()).tocoo()
    a, b = tree.row.astype(np.int64), tree.col.astype(np.int64)
    a, b = np.minimum(a, b), np.maximum(a, b)
    after = 4 * np.arange(cells.size)[:, None] + np.array([1, 2, 3, 0])
    across = b - a == 1  # right of each other
    left, right, low, high = a[across], b[across], a[~across], b[~across]
    after[left, 1], after[right, 3] = 4 * right + 0, 4 * left + 2
    after[low, 2], after[high, 0] = 4 * high + 1, 4 * low + 3
    return np.asarray(after.ravel())


@njit(cache=True, nogil=True)
def _visit(after, first, out):  # type: ignore[no-untyped-def]
    """Write the nodes from the first one on, until it comes again, into out; return how many."""
    node, count = first, 0
    while True:
        out[count] = node
        count += 1
        node = after[node]
        if node == first:
            return count


def _walk(after: np.ndarray, cell: int) -> np.ndarray:
    """Return nodes in order of visit, as `_follow_tree` numbers them, from the lower left one of a cell on."""
    out = np.empty(after.size, dtype=np.int64)
    return out[: _visit(after, 4 * cell, out)]


def _number_nodes(visited: np.ndarray, columns: int) -> np.ndarray:
    """Return flat numbers in the fine lattice of nodes 4 c + q; columns: of the coarse one."""
    row, column = np.divmod(visited // 4, columns)
    quarter = visited % 4
    up, right = quarter >= 2, (quarter == 1) | (quarter == 2)
    return np.asarray((2 * row + up) * (2 * columns) + 2 * column + right)


def _round_corners(nodes: np.ndarray, lattice: Lattice, pitch_mm: float) -> tuple[Array, np.ndarray]:
    """Return points (m, 2) of a closed way through nodes (n,), and the node (m,) that each leads through: from the
    middle of the way to it to the middle of the way from it.
    """
    row, column = np.divmod(nodes, lattice.x_mm.size)
    at = np.column_stack([lattice.x_mm[column], lattice.y_mm[row]])
    half_in, half_out = (at - np.roll(at, 1, axis=0)) / 2, (np.roll(at, -1, axis=0) - at) / 2
    turns = np.abs((half_in * half_out).sum(axis=1)) < 0.1 * pitch_mm**2
    angle = np.pi / 2 * np.arange(1, _CHORDS + 1) / _CHORDS
    arcs = (at - half_in + half_out)[:, None] + (
        half_in[:, None] * np.sin(angle)[:, None] - half_out[:, None] * np.cos(angle)[:, None]
    )
    arcs[~turns, -1] = (at + half_out)[~turns]
    wanted = np.zeros((nodes.size, _CHORDS), dtype=np.bool_)
    wanted[turns], wanted[:, -1] = True, True
    return arcs[wanted], np.repeat(np.arange(nodes.size), wanted.sum(axis=1))
