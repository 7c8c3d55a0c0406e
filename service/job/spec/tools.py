"""The tool library: the end mills of the shop.

`tools.toml` beside this module holds the usual ones; a person's own tools.toml in their configuration folder, beside
the folder of their machines, takes its place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from cam.tools import Tool
from machines.profile_values import BadValueError, Rules, number, text, whole
from phrases.phrase import Phrase
from service.errors import InputError
from service.job.spec.own_files import find_own_file, format_toml, read_library, require_own_file, write_own_file
from service.wording import align

BUILT_IN = Path(__file__).with_name("tools.toml")
_NAME = "tools.toml"


_VALUES = Rules(
    {
        "name": text(40, least=1),
        "radius_mm": number(0.05, 25, "mm"),
        "flutes": whole(1, 8),
        "flute_length_mm": number(0.1, 200, "mm"),
        "shank_radius_mm": number(0.1, 50, "mm"),
        "stick_out_mm": number(0.5, 300, "mm"),
        "max_rpm": number(100, 200_000, "rpm"),
        "cost_class": whole(1, 3),
        "corner_radius_mm": number(0, 25, "mm"),
        "number": whole(1, 9999),
    }
)


def library_file(given: Path | None = None) -> Path:
    """Return the file in use: the one given, or the person's own, or the built-in one."""
    if given is not None:
        return given
    own = find_own_file(_NAME)
    return own if own is not None and own.is_file() else BUILT_IN


def load_tools(given: Path | None = None) -> tuple[Tool, ...]:
    """Return the tools of the library, smallest ball first. InputError names file, key, value and what is allowed."""
    path = library_file(given)
    return _tools_of(path, read_library(path))


def save_tools(rows: Sequence[Mapping[str, Any]]) -> tuple[Tool, ...]:
    """Write the person's own library, completely or not at all, and return it. InputError names the fault of a row."""
    path = require_own_file(_NAME)
    tools = _tools_of(Path(path.name), {"tool": [dict(row) for row in rows]})
    write_own_file(path, "\n".join(_as_toml(tool) for tool in tools))
    return tools


def forget_tools() -> None:
    """Delete the person's own library, so that the built-in one is used."""
    require_own_file(_NAME).unlink(missing_ok=True)


def _as_toml(tool: Tool) -> str:
    values = {field.name: value for field in fields(Tool) if (value := getattr(tool, field.name)) is not None}
    return "[[tool]]\n" + format_toml(values)


def _tools_of(path: Path, data: dict[str, Any]) -> tuple[Tool, ...]:
    rows = data.pop("tool", [])
    if data:
        raise InputError(
            Phrase(
                "{path}: {key}: there is no such key; allowed: only [[tool]] tables", path=path, key=next(iter(data))
            )
        )
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(Phrase("{path}: tool: must be tables, each under a line [[tool]]", path=path))
    if not rows:
        raise InputError(Phrase("{path}: it lists no tool; allowed: one [[tool]] table or more", path=path))
    tools = [_tool(path, row, index) for index, row in enumerate(rows, 1)]
    names = [tool.name for tool in tools]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InputError(
            Phrase("{path}: name = {name}: allowed: a name that no other tool has", path=path, name=repr(twice)),
            field="tools",
        )
    return tuple(sorted(tools, key=lambda tool: (tool.radius_mm, tool.cost_class, tool.name)))


def _tool(path: Path, row: dict[str, Any], index: int) -> Tool:
    place = Phrase("{path}: tool {number}", path=path, number=index)
    try:
        values = {key: _VALUES.check(key, value, "") for key, value in row.items()}
        needed = ("name", "radius_mm", "flutes", "flute_length_mm", "max_rpm")
        if missing := [key for key in needed if key not in values]:
            raise InputError(Phrase("{place}: {keys}: missing", place=place, keys=", ".join(missing)))
        left_out = {
            "shank_radius_mm": values["radius_mm"], "stick_out_mm": values["flute_length_mm"], "cost_class": 2,
        }  # fmt: skip
        tool = Tool(**{**left_out, **values})
        for key, is_wrong, allowed in _list_limits(tool):
            if is_wrong:
                raise BadValueError(key, row[key], allowed)
    except BadValueError as error:
        words = Phrase("{place}: {cause}", place=place, cause=error.words)
        raise InputError(words, field=f"tools.{index - 1}.{error.key}") from None
    return tool


def _list_limits(tool: Tool) -> tuple[tuple[str, bool, Phrase], ...]:
    """Return the limits of a tool's figures that depend on other figures: key, whether it is wrong, what is allowed."""
    ball_mm, flutes_mm = tool.radius_mm, tool.flute_length_mm
    return (
        ("corner_radius_mm", (tool.corner_radius_mm or 0.0) > ball_mm,
         Phrase("0 (flat) to {radius_mm:g} mm, a ball", radius_mm=ball_mm)),
        ("flute_length_mm", flutes_mm < ball_mm,
         Phrase("at least the ball's radius, {radius_mm:g} mm", radius_mm=ball_mm)),
        ("stick_out_mm", tool.stick_out_mm < flutes_mm,
         Phrase("at least the flute length, {length_mm:g} mm", length_mm=flutes_mm)),
    )  # fmt: skip


def table(tools: tuple[Tool, ...], path: Path) -> list[str]:
    """Return the library as lines of a table."""
    head = (
        "NAME",
        "RADIUS",
        "FLUTES",
        "FLUTE LENGTH",
        "SHANK RADIUS",
        "STICK-OUT",
        "MOST RPM",
        "COST",
        "CORNER",
        "NUMBER",
    )
    rows = [head, *(tuple(_cell(field.name, getattr(tool, field.name)) for field in fields(Tool)) for tool in tools)]
    own = find_own_file(_NAME)
    where = f"your own, in place of these: {own}" if own is not None else "your own: set CAUSTICMILL_CONFIG_DIR"
    origin = "built in" if path == BUILT_IN else str(path)
    return [*align(rows), "", f"all lengths in mm, from: {origin}", *([where] if path == BUILT_IN else [])]


def _cell(key: str, value: object) -> str:
    if value is None:
        return "ball" if key == "corner_radius_mm" else "-"
    return f"{value:g}" if isinstance(value, float) else str(value)
