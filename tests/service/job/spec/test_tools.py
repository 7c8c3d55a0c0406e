"""The tool library: what a shop may write, what is refused in one line, which file is in use."""

from __future__ import annotations

import tempfile
from dataclasses import asdict
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InputError
from service.job.spec import tools

GOOD = '[[tool]]\nname = "a"\nradius_mm = 2\nflutes = 2\nflute_length_mm = 8\nmax_rpm = 30000\n'


def library(folder: Path, text: str) -> Path:
    path = folder / "tools.toml"
    path.write_text(text)
    return path


def test_the_shipped_library_has_the_usual_balls_and_flat_ones() -> None:
    found = tools.load_tools(tools.BUILT_IN)
    assert [tool.radius_mm for tool in found if tool.is_ball] == [0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0]
    assert {tool.corner_radius_mm for tool in found if not tool.is_ball} == {0.0, 1.0}
    assert all(tool.stick_out_mm >= tool.flute_length_mm >= tool.radius_mm for tool in found)


def test_what_is_left_out_is_the_plainest(tmp_path: Path) -> None:
    (tool,) = tools.load_tools(library(tmp_path, GOOD))
    assert (tool.shank_radius_mm, tool.stick_out_mm, tool.cost_class) == (2.0, 8.0, 2)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "colour = 1\n", ["tool 1", "colour = 1", "radius_mm, flutes"]),
        (GOOD.replace("radius_mm = 2", "radius_mm = -2"), ["tool 1", "radius_mm = -2", "0.05 to 25 mm"]),
        (GOOD.replace("flutes = 2", "flutes = 2.5"), ["flutes = 2.5", "whole number from 1 to 8"]),
        (GOOD.replace("max_rpm = 30000\n", ""), ["tool 1", "max_rpm", "missing"]),
        (GOOD.replace("flute_length_mm = 8", "flute_length_mm = 1"), ["flute_length_mm = 1", "radius, 2 mm"]),
        (GOOD + "corner_radius_mm = 3\n", ["corner_radius_mm = 3", "0 (flat) to 2 mm, a ball"]),
        (GOOD + "stick_out_mm = 5\n", ["stick_out_mm = 5", "flute length, 8 mm"]),
        (GOOD + GOOD, ["name = 'a'", "no other tool"]),
        ("tools = 3\n" + GOOD, ["tools", "[[tool]]"]),
        ("tool = 3\n", ["tool", "[[tool]]"]),
        ("", ["lists no tool"]),
        ("[[tool\n", ["not valid TOML"]),
    ],
)
def test_a_bad_library_is_one_line_with_file_key_value_and_allowed(tmp_path: Path, text: str, words: list[str]) -> None:
    path = library(tmp_path, text)
    with pytest.raises(InputError) as caught:
        tools.load_tools(path)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(path))
    assert all(word in line for word in words), line


def test_a_missing_library_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing\.toml"):
        tools.load_tools(tmp_path / "nothing.toml")


def test_a_persons_own_library_takes_the_place_of_the_shipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    assert tools.library_file() == tools.BUILT_IN
    library(tmp_path, GOOD)
    assert tools.library_file() == tmp_path / "tools.toml"
    (tool,) = tools.load_tools()
    assert tool.name == "a"
    assert any(str(tmp_path) in line for line in tools.table((tool,), tools.library_file()))


LENGTHS = st.floats(0.5, 20).map(lambda value: round(value, 3))


@given(st.lists(st.tuples(LENGTHS, LENGTHS, LENGTHS), min_size=1, max_size=8))
def test_tools_that_were_saved_are_those_that_are_there(rows: list[tuple[float, float, float]]) -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("CAUSTICMILL_CONFIG_DIR", str(Path(folder) / "shop"))
        asked = [
            {"name": f"Ø {number} \"own\"", "radius_mm": r, "flutes": 2, "flute_length_mm": r + flute,
             "shank_radius_mm": shank, "stick_out_mm": r + flute + shank, "max_rpm": 30000.0, "cost_class": 2,
             "corner_radius_mm": None if number % 2 else 0.0, "number": number + 1}
            for number, (r, flute, shank) in enumerate(rows)
        ]  # fmt: skip
        tools.save_tools([{key: value for key, value in row.items() if value is not None} for row in asked])
        assert sorted(map(str, asked)) == sorted(str(asdict(tool)) for tool in tools.load_tools())
        with pytest.raises(InputError, match="tool 1: flute_length_mm"):
            tools.save_tools([asked[0] | {"flute_length_mm": asked[0]["radius_mm"] / 2}])
        assert len(tools.load_tools()) == len(rows)
        tools.forget_tools()
        assert tools.library_file() == tools.BUILT_IN
