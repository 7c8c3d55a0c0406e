"""The lens as a solid for other shops: STEP AP214 (ISO 10303-21), in millimetres, in the work frame.

The milled face is the bicubic spline itself, as one B-spline surface: its control net has as many points as the
heightfield, not-a-knot knots at its nodes, and places with seven decimals, so that it lies within 0.2 nm of the spline.
The sides are upright and follow the outline of the lens, without the margin of the block; a round or oval lens has a
cylinder or an elliptic side, cut along the surface. The back is flat at -thickness.

A point of the net takes some 70 bytes of text, so that a net of 1025 x 1025 points makes 75 MB: files above MOST_BYTES
are packed (lens.stpZ: a ZIP of lens.step, which CAD programs read directly, or after unpacking).
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import ceil, dist

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from optics.heightfield import Array, Heightfield
from service.job.files import PACKED_STEP, STEP

MOST_BYTES = 50_000_000
_DECIMALS = 7  # of a millimetre: 0.1 nm
_SAMPLES_PER_CELL = 4  # along an edge that crosses the cells of the grid at any angle
_LEAST_SAMPLES = 9
_HEAD = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION(('lens, milled face as a bicubic B-spline surface'),'2;1');
FILE_NAME('lens.step','',(''),(''),'causticmill','causticmill','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));
ENDSEC;
DATA;
"""


def step_file(pieces: Iterable[bytes]) -> tuple[str, bytes]:
    """Return name and content of the file: plain, or packed if it would be larger than MOST_BYTES."""
    text = b"".join(pieces)
    if len(text) <= MOST_BYTES:
        return STEP, text
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(zipfile.ZipInfo(STEP), text, zipfile.ZIP_DEFLATED)
    return PACKED_STEP, packed.getvalue()


def step_pieces(
    lens: Heightfield, *, thickness_mm: float, outline: str | Sequence[Sequence[float]] = "rectangle"
) -> Iterator[bytes]:
    """Yield the text of the file.

    outline : "rectangle", "ellipse" (both as large as the aperture), or corners [mm], counter-clockwise
    """
    entities = _Entities()
    yield _HEAD.encode()
    surface = entities.add_surface(lens)
    yield entities.take()
    sides = _sides_of(lens, outline)
    tops = [side.top(lens) for side in sides]
    corners = [top.c[0] for top in tops]
    upper = [entities.add_vertex(place) for place in corners]
    lower = [entities.add_vertex((x, y, -thickness_mm)) for x, y, _ in corners]
    up = entities.add("DIRECTION('',(0.,0.,1.))")
    upright = [
        entities.add_edge(lower[k], upper[k], entities.add_line((x, y, -thickness_mm), (0.0, 0.0, 1.0)))
        for k, (x, y, _) in enumerate(corners)
    ]
    following = [(k + 1) % len(sides) for k in range(len(sides))]
    above = [entities.add_edge(upper[k], upper[n], entities.add_curve(tops[k])) for k, n in enumerate(following)]
    below = [
        entities.add_edge(lower[k], lower[n], sides[k].add_bottom(entities, -thickness_mm))
        for k, n in enumerate(following)
    ]
    faces = [entities.add_face(surface, [(edge, True) for edge in above])]
    for k, n in enumerate(following):
        around = [(below[k], True), (upright[n], True), (above[k], False), (upright[k], False)]
        faces.append(entities.add_face(sides[k].add_surface(entities, -thickness_mm, up), around))
    back = entities.add_plane((0.0, 0.0, -thickness_mm), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0))
    faces.append(entities.add_face(back, [(edge, False) for edge in reversed(below)]))
    entities.add_product(faces)
    yield entities.take()
    yield b"ENDSEC;\nEND-ISO-10303-21;\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Straight:
    """A flat side from one corner of the outline to the next.

    samples : at which the edge on the surface is interpolated
    """

    start_mm: Sequence[float]
    end_mm: Sequence[float]
    samples: int

    def top(self, lens: Heightfield) -> BSpline:
        """Return the edge on the surface: x, y, z over the length."""
        shares = np.linspace(0.0, 1.0, self.samples)[:, None]
        places = np.asarray(self.start_mm) * (1.0 - shares) + np.asarray(self.end_mm) * shares
        return _interpolate(lens, places, shares[:, 0] * dist(self.start_mm, self.end_mm))

    def _along(self) -> tuple[float, float]:
        length = dist(self.start_mm, self.end_mm)
        return (self.end_mm[0] - self.start_mm[0]) / length, (self.end_mm[1] - self.start_mm[1]) / length

    def add_bottom(self, entities: _Entities, z_mm: float) -> str:
        return entities.add_line((*self.start_mm, z_mm), (*self._along(), 0.0))

    def add_surface(self, entities: _Entities, z_mm: float, up: str) -> str:
        x, y = self._along()
        return entities.add_plane((*self.start_mm, z_mm), (y, -x, 0.0), (x, y, 0.0))


@dataclass(frozen=True, slots=True, kw_only=True)
class _HalfEllipse:
    """Half of the side of a round or oval lens, from an angle on."""

    centre_mm: tuple[float, float]
    radii_mm: tuple[float, float]
    from_rad: float
    samples: int

    def top(self, lens: Heightfield) -> BSpline:
        angles = self.from_rad + np.linspace(0.0, np.pi, self.samples)
        places = np.column_stack([np.cos(angles), np.sin(angles)]) * self.radii_mm + self.centre_mm
        return _interpolate(lens, places, angles - self.from_rad)

    def add_bottom(self, entities: _Entities, z_mm: float) -> str:
        a_mm, b_mm = self.radii_mm
        # an ellipse's greater radius is named first, along the axis of its placement
        axis = entities.add_placement(
            (*self.centre_mm, z_mm), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0) if a_mm >= b_mm else (0.0, 1.0, 0.0)
        )
        if a_mm == b_mm:
            return entities.add(f"CIRCLE('',{axis},{_real(a_mm)})")
        return entities.add(f"ELLIPSE('',{axis},{_real(max(a_mm, b_mm))},{_real(min(a_mm, b_mm))})")

    def add_surface(self, entities: _Entities, z_mm: float, up: str) -> str:
        if self.radii_mm[0] == self.radii_mm[1]:
            axis = entities.add_placement((*self.centre_mm, z_mm), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
            return entities.add(f"CYLINDRICAL_SURFACE('',{axis},{_real(self.radii_mm[0])})")
        rule = entities.add(f"VECTOR('',{up},1.)")
        return entities.add(f"SURFACE_OF_LINEAR_EXTRUSION('',{self.add_bottom(entities, z_mm)},{rule})")


def _sides_of(lens: Heightfield, outline: str | Sequence[Sequence[float]]) -> list[_Straight | _HalfEllipse]:
    """Return the sides, counter-clockwise seen from above."""
    (left, right), (front, rear) = lens.x_mm[[0, -1]].tolist(), lens.y_mm[[0, -1]].tolist()
    cell_mm = min(lens.dx_mm, lens.dy_mm) / _SAMPLES_PER_CELL
    if outline == "ellipse":
        radii = (right - left) / 2, (rear - front) / 2
        samples = ceil(np.pi * max(radii) / cell_mm) + 1
        centre = (left + right) / 2, (front + rear) / 2
        return [
            _HalfEllipse(centre_mm=centre, radii_mm=radii, from_rad=start, samples=samples) for start in (0.0, np.pi)
        ]
    if isinstance(outline, str):  # along the rims the nodes give the spline itself
        corners = [(left, front), (right, front), (right, rear), (left, rear)]
        counts = [lens.x_mm.size, lens.y_mm.size] * 2
    else:
        corners = [(float(x), float(y)) for x, y in outline]
        ends = zip(corners, [*corners[1:], corners[0]], strict=True)
        counts = [max(_LEAST_SAMPLES, ceil(dist(*pair) / cell_mm) + 1) for pair in ends]
    return [
        _Straight(start_mm=corner, end_mm=corners[(k + 1) % len(corners)], samples=count)
        for k, (corner, count) in enumerate(zip(corners, counts, strict=True))
    ]


def _interpolate(lens: Heightfield, places_mm: Array, at: Array) -> BSpline:
    """Return the cubic curve on the surface over the places (n, 2), which it reaches at the parameters `at`."""
    heights = lens.spline().heights_mm(places_mm[:, 0], places_mm[:, 1])
    return make_interp_spline(at, np.column_stack([places_mm, heights]), k=3)


def control_net(lens: Heightfield) -> tuple[BSpline, BSpline, Array]:
    """Return two splines, with the net's x (nx,) and y (ny,) as coefficients, and the net's heights (ny, nx)."""
    across, down = make_interp_spline(lens.x_mm, lens.x_mm, k=3), make_interp_spline(lens.y_mm, lens.y_mm, k=3)
    rows = make_interp_spline(lens.x_mm, lens.z_mm, k=3, axis=1).c  # scipy puts the axis of the coefficients first
    return across, down, make_interp_spline(lens.y_mm, rows.T, k=3).c


@dataclass(slots=True)
class _Entities:
    """The numbered lines of the file. Each method that adds an entity returns its name."""

    count: int = 0
    lines: list[str] = field(default_factory=list)

    def take(self) -> bytes:
        text = "".join(self.lines)
        self.lines = []
        return text.encode()

    def add(self, entity: str) -> str:
        self.count += 1
        self.lines.append(f"#{self.count}={entity};\n")
        return f"#{self.count}"

    def add_points(self, places: Iterable[str]) -> str:
        """Add points, each "x,y,z", and return their list."""
        first = self.count + 1
        text = [f"#{number}=CARTESIAN_POINT('',({place}));\n" for number, place in enumerate(places, first)]
        self.count += len(text)
        self.lines.append("".join(text))
        return "(" + ",".join([f"#{number}" for number in range(first, self.count + 1)]) + ")"

    def add_surface(self, lens: Heightfield) -> str:
        across, down, z_mm = control_net(lens)
        y_texts = [_real(y) for y in down.c]
        net = []
        for x_text, column in zip(map(_real, across.c), z_mm.T.tolist(), strict=True):
            net.append(self.add_points([f"{x_text},{y},{_real(z)}" for y, z in zip(y_texts, column, strict=True)]))
        points, (x_many, x_knots), (y_many, y_knots) = ",\n".join(net), _knots(across.t), _knots(down.t)
        return self.add(
            f"B_SPLINE_SURFACE_WITH_KNOTS('',3,3,({points}),.UNSPECIFIED.,.F.,.F.,.F.,"
            f"{x_many},{y_many},\n{x_knots},\n{y_knots},.UNSPECIFIED.)"
        )

    def add_curve(self, curve: BSpline) -> str:
        points = self.add_points([_place(place) for place in curve.c.tolist()])
        many, knots = _knots(curve.t)
        return self.add(
            f"B_SPLINE_CURVE_WITH_KNOTS('',3,{points},.UNSPECIFIED.,.F.,.F.,\n{many},\n{knots},.UNSPECIFIED.)"
        )

    def add_point(self, place_mm: Sequence[float]) -> str:
        return self.add(f"CARTESIAN_POINT('',({_place(place_mm)}))")

    def add_vertex(self, place_mm: Sequence[float]) -> str:
        return self.add(f"VERTEX_POINT('',{self.add_point(place_mm)})")

    def add_direction(self, direction: Sequence[float]) -> str:
        return self.add(f"DIRECTION('',({','.join(_exact(value) for value in direction)}))")

    def add_line(self, place_mm: Sequence[float], direction: Sequence[float]) -> str:
        vector = self.add(f"VECTOR('',{self.add_direction(direction)},1.)")
        return self.add(f"LINE('',{self.add_point(place_mm)},{vector})")

    def add_placement(self, place_mm: Sequence[float], axis: Sequence[float], x_axis: Sequence[float]) -> str:
        return self.add(
            f"AXIS2_PLACEMENT_3D('',{self.add_point(place_mm)},{self.add_direction(axis)},{self.add_direction(x_axis)})"
        )

    def add_plane(self, place_mm: Sequence[float], normal: Sequence[float], x_axis: Sequence[float]) -> str:
        return self.add(f"PLANE('',{self.add_placement(place_mm, normal, x_axis)})")

    def add_edge(self, start: str, end: str, curve: str) -> str:
        return self.add(f"EDGE_CURVE('',{start},{end},{curve},.T.)")

    def add_face(self, surface: str, edges: Sequence[tuple[str, bool]]) -> str:
        """Add a face with the outward side of its surface, and its edges counter-clockwise seen from outside."""
        around = [self.add(f"ORIENTED_EDGE('',*,*,{edge},{'.T.' if along else '.F.'})") for edge, along in edges]
        loop = self.add(f"EDGE_LOOP('',({','.join(around)}))")
        bound = self.add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        return self.add(f"ADVANCED_FACE('',({bound}),{surface},.T.)")

    def add_product(self, faces: Sequence[str]) -> None:
        """Add the solid, its units, and the product that it is the shape of."""
        shell = self.add(f"CLOSED_SHELL('',({','.join(faces)}))")
        solid = self.add(f"MANIFOLD_SOLID_BREP('lens',{shell})")
        length = self.add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
        angle = self.add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
        solid_angle = self.add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
        accuracy = self.add(
            f"UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-06),{length},'distance_accuracy_value','')"
        )
        space = self.add(
            f"(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT(({accuracy}))"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{angle},{solid_angle}))REPRESENTATION_CONTEXT('',''))"
        )
        frame = self.add_placement((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
        shape = self.add(f"ADVANCED_BREP_SHAPE_REPRESENTATION('',({frame},{solid}),{space})")
        context = self.add("APPLICATION_CONTEXT('core data for automotive mechanical design processes')")
        self.add(f"APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,{context})")
        mechanical = self.add(f"PRODUCT_CONTEXT('',{context},'mechanical')")
        product = self.add(f"PRODUCT('lens','lens','',({mechanical}))")
        version = self.add(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        use = self.add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{context},'design')")
        definition = self.add(f"PRODUCT_DEFINITION('design','',{version},{use})")
        defined = self.add(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
        self.add(f"SHAPE_DEFINITION_REPRESENTATION({defined},{shape})")
        self.add(f"PRODUCT_RELATED_PRODUCT_CATEGORY('part',$,({product}))")


def _real(value: float) -> str:
    """Return a length in mm; a real number of the format has a point, and digits before it."""
    text = f"{value:.{_DECIMALS}f}".rstrip("0")
    return "0." if text == "-0." else text


def _exact(value: float) -> str:
    text = repr(float(value)).upper()
    return text if "." in text else text.replace("E", ".E") if "E" in text else f"{text}."


def _place(place_mm: Sequence[float]) -> str:
    return ",".join(map(_real, place_mm))


def _knots(knots: Array) -> tuple[str, str]:
    """Return multiplicities and distinct knots as lists."""
    values, many = np.unique(knots, return_counts=True)
    return f"({','.join(map(str, many.tolist()))})", f"({','.join(map(_exact, values.tolist()))})"
