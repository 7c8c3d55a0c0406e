"""A spec in which every figure is given that has no usual value, and another allowed value for each of its keys: as it
stands in OTHER, or in ALONE, or any that the schema allows.
"""

from __future__ import annotations

from typing import Any

from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec

_ROW = {
    "radius_mm": 3.0, "plunge_mm_per_min": 300.0, "spindle_rpm": 9000.0, "flute_length_mm": 15.0,
    "shank_radius_mm": 3.0,
}  # fmt: skip
_GIVEN: dict[str, Any] = {
    "preset": "draft",
    "image": {"pixels": 24, "tone": "linear"},
    "optics": {
        "width_mm": 4.0, "height_mm": 4.0, "throw_mm": 20.0, "screen_width_mm": 4.0, "screen_height_mm": 4.0,
        "min_radius_mm": 3.0, "corrections": 0, "branch": "direct",
    },
    "stock": {"thickness_mm": 20.0, "margin_mm": 2.0},
    "passes": [
        {**_ROW, "name": "rough", "pitch_mm": 1.0, "stock_to_leave_mm": 0.2, "step_down_mm": 1.5,
         "feed_mm_per_min": 1200.0},
        {**_ROW, "pitch_mm": 0.25, "step_down_mm": 0.4, "feed_mm_per_min": 1000.0},
    ],
    "machine": {
        "travel_mm": [200.0, 200.0, 60.0], "max_rate_mm_per_min": [2000.0, 2000.0, 600.0],
        "acceleration_mm_per_s2": [100.0, 100.0, 50.0], "step_mm": 0.005, "z_noise_mm": 0.0005,
        "screw_error_mm": [0.001, 0.0, 0.001], "screw_lead_mm": [2.0, 2.0, 2.0], "junction_deviation_mm": 0.01,
        "planner_blocks": 15, "lines_per_s": 100.0, "safe_z_mm": 5.0, "spindle_rpm": [1000.0, 20000.0],
        "whole_steps": False, "most_program_mb": 100.0, "most_program_hours": 100.0, "coolant": "none",
        "high_precision": "none", "work_offset": 1, "warm_up_s": 0.0, "collet_mm": 6.35, "spindle_w": 500.0,
        "removal_cm3_per_min": 6.0, "trace_outline": False,
    },
}  # fmt: skip
BASE: dict[str, Any] = JobSpec.model_validate(_GIVEN).model_dump(mode="json")
OTHER: dict[str, Any] = {
    "image.fit": "stretch", "optics.width_mm": 4.5, "optics.height_mm": 3.5, "optics.screen_width_mm": 4.4,
    "optics.screen_height_mm": 3.6, "optics.screen_shift_x_mm": 1.0, "optics.screen_shift_y_mm": -1.0,
    "optics.branch": "inverted", "optics.outline": "ellipse", "optics.foreseen_blur_mm": [0.2, 0.1],
    "optics.light.profile": [[1.0, 0.5], [0.8, 0.9]], "optics.light.spectrum": "monochromatic",
    "machine.profile": "grbl-3018", "machine.travel_mm": [190.0, 190.0, 55.0],
    "machine.max_rate_mm_per_min": [1900.0, 1900.0, 500.0], "machine.acceleration_mm_per_s2": [90.0, 90.0, 40.0],
    "machine.screw_error_mm": [0.002, 0.0, 0.001], "machine.screw_lead_mm": [2.0, 2.0, 1.25],
    "machine.most_program_mb": 0.1, "machine.most_program_hours": 0.05, "machine.collet_mm": 8.0,
    "machine.bed_to_collet_mm": 120.0, "machine.table_mm": [150.0, 150.0], "machine.gantry_mm": 90.0,
    "stock.base_mm": 30.0, "passes.0.stick_out_mm": 25.0, "passes.1.stick_out_mm": 25.0,
    "machine.spindle_rpm": [2000.0, 19000.0], "passes.0.name": "other", "passes.1.name": "other",
    "stock.material": "polycarbonate", "passes.0.tool_name": "ball-a", "passes.1.tool_name": "ball-b",
}  # fmt: skip
ONLY_ONE_VALUE = {"passes.0.where", "passes.1.corner_radius_mm"}
LINUXCNC = {"machine.profile": "linuxcnc"}
CHANGING = {
    **LINUXCNC, "machine.tool_change": True, "machine.top_z_mm": 0.0, "machine.most_program_mb": None,
    "machine.most_program_hours": None,
}  # fmt: skip
ROOMY = {"stock.margin_mm": 16.0, "machine.safe_z_mm": 30.0}
POINT = {"optics.light": {"kind": "point", "distance_mm": 300.0, "size_mm": 1.0}}
CLAMP = {"x_mm": -40.0, "y_mm": 0.0, "width_mm": 5.0, "depth_mm": 5.0, "height_mm": 3.0}
FELT = {"process": "felt", "k0_rad_per_mm": 3.0, "order": 1.0, "depth_um": 10.0, "minutes": 2.0, "pad_mm": 10.0}
ALONE: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # of a key whose values go with others only: two specs
    **{f"plan.{aim}": ({}, {f"plan.{aim}": 9.0}) for aim in ("hours", "blur_mm", "psnr_db")},
    "image.prepare_detail_mm": (
        {"image.prepare": "detail"}, {"image.prepare": "detail", "image.prepare_detail_mm": 2.0},
    ),
    "optics.method": ({}, {"optics.method": "paper"}),
    "optics.creases": ({"optics.min_radius_mm": 0.0}, {"optics.min_radius_mm": 0.0, "optics.creases": True}),
    "finish.process": ({"finish": FELT}, {"finish": {**FELT, "process": "sanding"}}),
    **{f"finish.{key}": ({"finish": FELT}, {"finish": {**FELT, key: 2.5}}) for key in FELT if key != "process"},
    "finish.witness": ({"finish": FELT}, {"finish": {**FELT, "witness": False}}),
    "passes.1.where": ({}, {"passes.1.where": "rest"}),
    "passes.0.corner_radius_mm": ({}, {"passes.0.corner_radius_mm": 0.5}),
    "stock.face": ({}, {"stock.face": {"above_mm": 0.5}}),
    "stock.cut_out": ({}, {"stock.cut_out": {"radius_mm": 0.5, "tabs": 1, "tab_width_mm": 1.0}}),
    "stock.clamps": ({}, {"stock.clamps": [CLAMP]}),
    "stock.clamping": (ROOMY, {**ROOMY, "stock.clamping": "strap-m6"}),
    "machine.top_z_mm": (LINUXCNC, {**LINUXCNC, "machine.top_z_mm": -1.0}),
    "machine.tool_change": (LINUXCNC, {**LINUXCNC, "machine.tool_change": True}),
    "machine.one_program": (CHANGING, {**CHANGING, "machine.one_program": True}),
    "machine.optional_stop": (LINUXCNC, {**LINUXCNC, "machine.optional_stop": True}),
    "machine.number_every": (LINUXCNC, {**LINUXCNC, "machine.number_every": 1}),
    "machine.blend_tolerance_mm": (LINUXCNC, {**LINUXCNC, "machine.blend_tolerance_mm": 0.002}),
    "machine.high_precision": ({}, {"machine.high_precision": None}),
    "optics.light.kind": ({}, {"optics.light": {"kind": "sun"}}),
    "optics.light.size_deg": ({"optics.light": {"kind": "sun"}}, {"optics.light": {"kind": "sun", "size_deg": 1.0}}),
    "optics.light.distance_mm": (POINT, {"optics.light": {**POINT["optics.light"], "distance_mm": 400.0}}),
    "optics.light.size_mm": (POINT, {"optics.light": {**POINT["optics.light"], "size_mm": 2.0}}),
    "optics.light.gaussian_mm": ({}, {"optics.light": {"gaussian_mm": 9.0}}),
}  # fmt: skip


def spec_with(*keys: str) -> JobSpec:
    """BASE, with the other value at each of these keys."""
    return spec_of({key: OTHER[key] for key in keys})


def spec_of(changes: dict[str, Any]) -> JobSpec:
    """BASE, with these values at these keys; a table is replaced whole."""
    return resolve_spec(base=_changed(BASE, "", changes))


def leaves(data: Any) -> list[str]:
    """Dotted keys of all single values; a list of numbers is one."""
    return list(flatten(data))


def flatten(data: Any, place: str = "") -> dict[str, Any]:
    """The single values by their dotted keys."""
    if isinstance(data, list | tuple) and data and isinstance(data[0], dict):
        data = dict(enumerate(data))
    if not isinstance(data, dict):
        return {place: data}
    found = (flatten(value, f"{place}.{name}".lstrip(".")) for name, value in data.items())
    return {key: value for inner in found for key, value in inner.items()}


def _changed(data: Any, place: str, changes: dict[str, Any]) -> Any:
    if place in changes:
        return changes[place]
    if isinstance(data, dict):
        return {name: _changed(value, f"{place}.{name}".lstrip("."), changes) for name, value in data.items()}
    if isinstance(data, list) and isinstance(data[0], dict):
        return [_changed(value, f"{place}.{number}", changes) for number, value in enumerate(data)]
    return data


_SCHEMA = JobSpec.model_json_schema()


def schema_of(key: str) -> dict[str, Any]:
    """What the spec's JSON schema says of a dotted key."""
    told = _target(_SCHEMA)
    for step in key.split("."):
        told = _target(told["items"] if step.isdecimal() else told["properties"][step])
    return told


def _another(key: str, value: Any) -> Any:
    """Near the value, or at the low end of what is allowed."""
    told = schema_of(key)
    if "enum" in told:
        return next(other for other in told["enum"] if other != value)
    if told["type"] == "boolean":
        return not value
    low = told["minimum"]
    other = low + 0.01 * (told["maximum"] - low) if value in (None, low) else value - 0.1 * (value - low)
    return other if told["type"] == "number" else round(other) + (round(other) == value)


def _target(told: dict[str, Any]) -> dict[str, Any]:
    """What a reference stands for, and of "this or nothing" this."""
    one = next((one for one in told.get("anyOf", ()) if one.get("type") != "null"), told)
    return _SCHEMA["$defs"][one["$ref"].rpartition("/")[2]] if "$ref" in one else one


OTHER |= {
    key: _another(key, value) for key, value in flatten(BASE).items() if key not in {*OTHER, *ALONE, *ONLY_ONE_VALUE}
}
