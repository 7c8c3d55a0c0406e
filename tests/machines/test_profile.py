"""Machine profiles: complete, plausible, frozen; an unknown name lists the known."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path

import pytest

from machines.profile import (
    LinkSettings,
    MachineProfile,
    ProfileError,
    SpindleSettings,
    UnknownProfileError,
    find_profiles,
    load_profile,
    profile_names,
    user_folders,
)
from machines.profile_values import DIALECTS, DRIVERS, Rules


@pytest.mark.parametrize("name", profile_names())
def test_every_profile_is_complete_and_plausible(name: str) -> None:
    profile = load_profile(name)
    assert profile.name == name
    assert profile.dialect in DIALECTS
    assert profile.link.driver in DRIVERS
    assert profile.description
    for triple in (profile.travel_mm, profile.max_rate_mm_per_min, profile.acceleration_mm_per_s2):
        assert len(triple) == 3
        assert min(triple) > 0
    assert 0 < profile.safe_z_mm < profile.travel_mm[2]
    assert 0 <= profile.spindle_rpm[0] < profile.spindle_rpm[1]
    assert 1 <= profile.planner_blocks <= 1000
    assert 0 < profile.step_mm <= 0.05
    assert 0 < profile.junction_deviation_mm <= 0.1
    assert profile.lines_per_s > 0


def test_every_field_of_a_profile_says_what_it_takes() -> None:
    for of, tables in ((MachineProfile, {"link", "spindle"}), (LinkSettings, set()), (SpindleSettings, set())):
        assert {*Rules.of(of).keys} == {field.name for field in fields(of)} - tables


def test_the_default_profile_takes_the_default_job() -> None:
    """100 mm aperture, 3 mm ball run-out on both sides, 40 mm stock below the safe height."""
    travel = load_profile("grbl").travel_mm
    assert min(travel[:2]) >= 106
    assert travel[2] >= 40 + load_profile("grbl").safe_z_mm


def test_an_unknown_profile_lists_the_known() -> None:
    with pytest.raises(UnknownProfileError) as caught:
        load_profile("haas")
    assert caught.value.known == profile_names()
    assert "'haas'" in str(caught.value)
    assert "grbl-3018" in str(caught.value)


def test_a_name_is_never_a_path() -> None:
    with pytest.raises(UnknownProfileError):
        load_profile("../profiles/grbl")


def test_profiles_are_frozen() -> None:
    with pytest.raises(FrozenInstanceError):
        load_profile("grbl").safe_z_mm = 1.0  # type: ignore[misc]


def written(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_profile_of_ones_own_gives_only_what_differs(tmp_path: Path) -> None:
    port = "/dev/serial/by-id/usb-1a86"
    text = f'extends = "grbl"\ntravel_mm = [280, 175, 40]\n[link]\nport = "{port}"\nbaud = 250000\n'
    written(tmp_path, "bench", text)
    bench, base = load_profile("bench", [tmp_path]), load_profile("grbl", [tmp_path])
    own_link = replace(base.link, port=port, baud=250000)
    unknown = {"table_mm": None, "bed_to_collet_mm": None, "gantry_mm": None, "guesses": ()}  # of another travel
    assert bench == replace(base, name="bench", travel_mm=(280.0, 175.0, 40.0), link=own_link, **unknown)
    assert "bench" in profile_names([tmp_path])


def test_profiles_extend_each_other_but_not_in_a_ring(tmp_path: Path) -> None:
    written(tmp_path, "a", 'extends = "b"\nsafe_z_mm = 7\n')
    written(tmp_path, "b", 'extends = "grbl"\nsafe_z_mm = 6\nstep_mm = 0.01\n')
    assert (load_profile("a", [tmp_path]).safe_z_mm, load_profile("a", [tmp_path]).step_mm) == (7, 0.01)
    written(tmp_path, "b", 'extends = "a"\n')
    with pytest.raises(ProfileError, match="extends = "):
        load_profile("a", [tmp_path])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("travel = 3", "travel = 3: allowed: the keys name"),
        ("travel_mm = [1, 2]", "travel_mm = [1, 2]: allowed: three numbers"),
        ("travel_mm = [1, 2, nan]", "three numbers"),
        ('dialect = "heidenhain"', "dialect = 'heidenhain': allowed: 'grbl'"),
        ("planner_blocks = 15.5", "a whole number"),
        ("planner_blocks = true", "a whole number"),
        ("homing = 1", "homing = 1: allowed: true or false"),
        ("spindle_rpm = [9, 8]", "[slowest, fastest]"),
        ('name = "other"', "the name of the file"),
        ("safe_z_mm = 100", "less than the travel in Z"),
        ('[link]\ndriver = "usb"', "link.driver = 'usb': allowed: 'grbl'"),
        ("[link]\nbauds = 9600", "link.bauds = 9600: allowed: the keys driver, baud"),
        ("link = 3", "link = 3: allowed: a table"),
        ("travel_mm = [1", "not valid TOML"),
    ],
)
def test_a_bad_file_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path, "bench", f'extends = "grbl"\n{text}\n')
    with pytest.raises(ProfileError) as caught:
        load_profile("bench", [tmp_path])
    assert str(path) in str(caught.value) and words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"bench": 'extends = "bench"'}, "a profile that does not lead back to this one ('bench' -> 'bench')"),
        (
            {"bench": 'extends = "b"', "b": 'extends = "bench"'},
            "extends 'b', which cannot be used: ",
        ),
        ({"bench": 'extends = "b"', "b": 'extends = "bench"'}, "('bench' -> 'b' -> 'bench')"),
        ({"bench": 'extends = "nope"'}, "extends = 'nope': allowed: 'grbl', 'grbl-3018'"),
        ({"bench": "extends = 5"}, "extends = 5: allowed: 'grbl'"),
        ({"bench": 'extends = "b"', "b": "wings = 2"}, "which cannot be used: "),
        ({"bench": ""}, "missing; give them"),
        ({"bench": b'extends = "grbl"\ndescription = "caf\xe9"'}, "is not UTF-8 text"),
        ({"bench": "planner_blocks = " + "9" * 5000}, "not valid TOML: Exceeds the limit"),
        ({"bench": "a = " + "[" * 100_000}, "not valid TOML: "),
        ({"bench": "#" * 2_000_000}, "is too large; a file of data has at most 1000000 bytes"),
        ({"bench": None}, "is a folder"),
        ({"bench": Path("nowhere.toml")}, "a link to a file that is not there"),
    ],
)
def test_files_that_cannot_be_used_are_one_line_each(tmp_path: Path, files: dict[str, object], words: str) -> None:
    for name, text in files.items():
        path = tmp_path / f"{name}.toml"
        if text is None:
            path.mkdir()
        elif isinstance(text, Path):
            path.symlink_to(text)
        else:
            path.write_bytes(text if isinstance(text, bytes) else str(text).encode())
    with pytest.raises(ProfileError) as caught:
        load_profile("bench", [tmp_path])
    said = str(caught.value)
    assert words in said and said.startswith(str(tmp_path / "bench.toml")) and "\n" not in said


def test_no_right_to_read_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path, "bench", 'extends = "grbl"')

    def refuse(*_: object, **__: object) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(ProfileError, match=r"bench\.toml: cannot be read: Permission denied"):
        load_profile("bench", [tmp_path])


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_bytes(b'\xef\xbb\xbfextends = "grbl"\r\nsafe_z_mm = 3\r\n')
    assert load_profile("bench", [tmp_path]).safe_z_mm == 3


def test_a_file_that_extends_nothing_must_be_complete(tmp_path: Path) -> None:
    written(tmp_path, "bench", 'dialect = "grbl"\n')
    with pytest.raises(ProfileError, match="missing; give them, or start from a profile"):
        load_profile("bench", [tmp_path])


def test_where_own_profiles_are_looked_for(tmp_path: Path) -> None:
    assert user_folders({"CAUSTICMILL_CONFIG_DIR": "/c", "XDG_CONFIG_HOME": "/x", "HOME": "/h"}) == (
        Path("/c/machines"),
    )
    assert user_folders({"XDG_CONFIG_HOME": "/x", "HOME": "/h"}) == (Path("/x/causticmill/machines"),)
    assert user_folders({"HOME": "/h"}) == (Path("/h/.config/causticmill/machines"),)
    assert user_folders({}) == ()
    path = written(tmp_path, "grbl", 'extends = "grbl-3018"\n')
    assert find_profiles([tmp_path])["grbl"] == str(path), "one's own takes the place of a built-in"


@pytest.mark.parametrize(
    ("link", "bytes_per_s"), [((8, "N", 1), 11_520), ((7, "E", 2), 115_200 / 11), ((7, "E", 1), 11_520)]
)
def test_wire_rate_counts_start_parity_and_stop_bits(link: tuple[int, str, float], bytes_per_s: float) -> None:
    bytesize, parity, stopbits = link
    settings = LinkSettings(bytesize=bytesize, parity=parity, stopbits=stopbits)
    assert settings.wire_bytes_per_s == pytest.approx(bytes_per_s)
