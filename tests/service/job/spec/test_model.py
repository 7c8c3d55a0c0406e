"""The job spec: complete defaults, exact types, one line for a bad value: key, value, allowed range."""

from __future__ import annotations

import json
from itertools import pairwise
from math import cos, pi, sin
from pathlib import Path
from traceback import walk_tb
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from service.errors import SpecError
from service.job.spec.loading import (
    default_layer,
    parse_override,
    require_same_lens,
    resolve_for_lens,
    resolve_job,
    resolve_spec,
    validate_spec,
)
from service.job.spec.model import JobSpec
from service.job.spec.section import RuleError, Section
from tests.service.job.stages.variants import BASE, flatten, schema_of

BAD_VALUES = [
    # override, key in the message, what else the message must hold
    ("optics.widht_mm=3", "optics.widht_mm", ["width_mm"]),
    ("optics.width_mm=wide", "optics.width_mm", ["'wide'", "from 0.5", "2000 mm"]),
    ("optics.width_mm=nan", "optics.width_mm", ["nan", "2000"]),
    ("optics.width_mm=inf", "optics.width_mm", ["inf", "2000"]),
    ("optics.width_mm=true", "optics.width_mm", ["true", "number"]),
    ("optics.width_mm=[1]", "optics.width_mm", ["[1]", "number"]),
    ("optics.corrections=1.5", "optics.corrections", ["1.5", "whole number"]),
    ("optics.outline=star", "optics.outline", ["'star'", "'rectangle', 'ellipse'", "3 to 256 corners"]),
    ("optics.outline=[[0,0],[1,1]]", "optics.outline", ["3 to 256 corners"]),
    ("optics.outline=[[0,0],[1,1],[2]]", "optics.outline", ["3 to 256 corners"]),
    ("optics.outline=[[0,0],[1,nan],[2,2]]", "optics.outline", ["nan", "3 to 256 corners"]),
    ("optics.outline=[[0,0],[101,0],[50,90]]", "optics.outline", ["corner 1", "X 101 Y 0", "100 x 100 mm"]),
    ("optics.outline=[[0,0],[90,90],[90,0],[0,80]]", "optics.outline", ["sides 0 and 2 cross"]),
    ("optics.outline=[[0,0],[0,0],[90,0],[0,80]]", "optics.outline", ["corners 0 and 1", "same point"]),
    ("optics.outline=[[0,0],[20,0],[0,20]]", "optics.outline", ["2 % of the aperture", "at least 5 %"]),
    ("optics.light.kind=moon", "optics.light.kind", ["'moon'", "'collimated', 'sun', 'point'"]),
    ("optics.light.kind=point", "optics.light.distance_mm", ["missing", "'point'", "10 to 100000 mm"]),
    (
        "optics.light.spectrum=green",
        "optics.light.spectrum",
        ["'green'", "'white', 'sun', 'monochromatic'", "400 to 700"],
    ),
    ("optics.light.spectrum={centre_nm=530}", "optics.light.spectrum", ["centre_nm", "width_nm from 1 to 200"]),
    (
        "optics.light.spectrum={centre_nm=300, width_nm=20}",
        "optics.light.spectrum",
        ["300", "centre_nm from 400 to 700"],
    ),
    ("optics.light.spectrum=[1]", "optics.light.spectrum", ["[1]", "'white'"]),
    ("optics.light.size_deg=1", "optics.light.size_deg", ["1 ", "kind = 'collimated'", "'sun'"]),
    ("optics.light={kind='sun', size_mm=2}", "optics.light.size_mm", ["2 ", "kind = 'sun'", "'point'"]),
    ("optics.light={kind='point', distance_mm=1}", "optics.light.distance_mm", ["1 ", "10 to 100000 mm"]),
    ("optics.light={kind='sun', size_deg=40}", "optics.light.size_deg", ["40", "to 10 degrees"]),
    ("optics.light.profile=[[1,2]]", "optics.light.profile", ["1 rows", "2 to 128 rows"]),
    ("optics.light.profile=[[1,2],[3]]", "optics.light.profile", ["row 1 has 1 values, row 0 has 2"]),
    ("optics.light.profile=[[1,2],[3,-4]]", "optics.light.profile", ["row 1 holds -4", "none negative"]),
    ("optics.light.profile=[[1,2],[3,'x']]", "optics.light.profile", ["row 1 holds 'x'"]),
    ("optics.light.profile=[[0,0],[0,0]]", "optics.light.profile", ["dark everywhere"]),
    ("optics.light.profile=3", "optics.light.profile", ["not a list of rows"]),
    ("optics.light={gaussian_mm=80, profile=[[1,1],[1,1]]}", "optics.light.gaussian_mm", ["80 ", "beside profile"]),
    ("optics.light.gaussian_mm=20", "optics.light.gaussian_mm", ["20 leaves", "at least 50 mm"]),
    ("optics={creases=true, min_radius_mm=1}", "optics.creases", ["min_radius_mm = 1"]),
    ("optics={method='paper', surface='mirror'}", "optics.surface", ["'lens'", "'paper'", "'transport'"]),
    ("optics={method='paper', polish=true}", "optics.polish", ["only false", "'paper'"]),
    (
        "optics={method='paper', light={gaussian_mm=90}}",
        "optics.light.gaussian_mm",
        ["parallel, even light", "'paper'"],
    ),
    (
        "optics={method='paper', light={kind='point', distance_mm=90}}",
        "optics.light.kind",
        ["parallel, even light", "'paper'"],
    ),
    (
        "optics={vertices_per_pixel=8, creases=true, height_mm=110}",
        "optics.vertices_per_pixel",
        ["563 pixels", "at most 8192"],
    ),
    ("optics.height_mm=1", "image.pixels", ["512", "rows", "16 to 4096"]),
    ("image=3", "image", ["3", "pixels, tone, fit, invert"]),
    ("stock.material=glass", "stock.material", ["'glass'", "'pmma'"]),
    ("passes.0.pitch_mm=9", "passes.0.pitch_mm", ["9", "radius_mm = 3"]),
    ("passes.0.where=rest", "passes.0.where", ["no pass before it"]),
    ("passes.0.corner_radius_mm=9", "passes.0.corner_radius_mm", ["9 is more", "radius_mm = 3"]),
    ("passes.2.corner_radius_mm=0", "passes.2.corner_radius_mm", ["only a ball can finish"]),
    (
        "passes.1={radius_mm=1, pitch_mm=0.1, stock_to_leave_mm=1, corner_radius_mm=0}",
        "passes.1.corner_radius_mm",
        ["first"],
    ),
    ("stock.material=brass", "stock.material", ["brass (mirror) lets no light through", "optics.surface = 'mirror'"]),
    ("stock.face={pitch_mm=9}", "stock.face.pitch_mm", ["9 leaves stock", "to 6"]),
    ("stock={cut_out={}, margin_mm=1}", "stock.margin_mm", ["1 leaves 1 mm", "allowed: a margin of at least 4"]),
    ("stock.cut_out={tab_height_mm=30}", "stock.cut_out.tab_height_mm", ["30", "at most 20"]),
    ("stock.cut_out={tabs=50, tab_width_mm=90}", "stock.cut_out.tabs", ["50 of 90 mm", "at most 4"]),
    ("passes.1={radius_mm=1, pitch_mm=0.1, where='rest', strategy='contour'}", "passes.1.where", ["rows only"]),
    ("passes.1.shank_radius_mm=2", "passes.1.shank_radius_mm", ["2 has no effect", "flute_length_mm"]),
    ("passes.0.name='A B'", "passes.0.name", ["'A B'", "lower-case"]),
    ("passes.0.name='../x'", "passes.0.name", ["'../x'", "lower-case"]),
    ("passes.0.spindle_rpm=100", "passes.0.spindle_rpm", ["100", "8000 to 30000 rpm"]),
    ("passes.0.feed_mm_per_min=9999", "passes.0.feed_mm_per_min", ["9999", "5000 mm/min"]),
    ("passes.3.pitch_mm=1", "passes.3", ["0 to 2"]),
    ("passes.x.pitch_mm=1", "passes.x", ["0 to 2"]),
    ("passes=[]", "passes", ["empty"]),
    ("passes=[{radius_mm=1}]", "passes.0.pitch_mm", ["missing", "0.002"]),
    ("plan={hours=3, blur_mm=1}", "plan.blur_mm", ["hours and blur_mm", "one of them"]),
    ("plan.speed=1", "plan.speed", ["hours, blur_mm, psnr_db"]),
    ("optics.foreseen_blur_mm=[1]", "optics.foreseen_blur_mm", ["2 numbers"]),
    ("preset=best", "preset", ["'best'", "'paper', 'draft', 'recommended'"]),
    ("machine.profile=haas", "machine.profile", ["'haas'", "'grbl'"]),
    ("machine.travel=[1,2,3]", "machine.travel", ["'travel_mm'"]),
    ("machine.travel_mm=[1,2]", "machine.travel_mm", ["[1, 2]", "3 numbers"]),
    ("machine.travel_mm=[1,2,-3]", "machine.travel_mm.2", ["-3", "from 1", "mm"]),
    ("machine.travel_mm=[1,'a',3]", "machine.travel_mm.1", ["'a'", "number"]),
    ("machine.spindle_rpm=[5,1]", "machine.spindle_rpm", ["slowest"]),
    ("colour=red", "colour", ["plan, image, optics, stock, passes, finish, machine"]),
    ("optics.width_mm", "--set", ["key=value"]),
    ("optics.width_mm=", "--set", ["key=value"]),
    ("=3", "--set", ["key=value"]),
]


@pytest.mark.parametrize(("override", "key", "words"), BAD_VALUES)
def test_a_bad_value_is_one_line_with_key_value_and_range(override: str, key: str, words: list[str]) -> None:
    with pytest.raises(SpecError) as caught:
        resolve_spec(overrides=[override])
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"{key}:")
    assert all(word in line for word in words), line


def test_a_rule_about_a_whole_table_names_the_key_that_a_person_should_change() -> None:
    """None of their refusals stands at a table, which has no row on the page. BAD_VALUES has one for each rule."""
    rules = {
        f"{model.__name__}.{name}"
        for model in (JobSpec, *(section for section in Section.__subclasses__()))
        for name in model.__pydantic_decorators__.model_validators
    }
    seen = set()
    for override, key, _ in BAD_VALUES:
        with pytest.raises(SpecError) as caught:
            resolve_spec(overrides=[override])
        cause = caught.value.__context__
        for detail in cause.errors() if isinstance(cause, ValidationError) else ():
            error = detail.get("ctx", {}).get("error")
            if isinstance(error, RuleError):
                assert schema_of(key).get("type") != "object" and key != "spec", override
                seen |= {rule for rule in rules if _raised_in(error, rule)}
    assert seen == rules


def _raised_in(error: BaseException, rule: str) -> bool:
    """Whether a function of this qualified name raised the error, or called what raised it."""
    frames = walk_tb(error.__traceback__)
    return any(frame.f_code.co_qualname == rule for frame, _ in frames)


BOUNDED = [key for key in flatten(BASE) if {"enum", "minimum"} & set(schema_of(key)) and "light" not in key]


@pytest.mark.parametrize("key", BOUNDED)
def test_every_bounded_key_refuses_what_is_beyond_and_says_what_is_allowed(key: str) -> None:
    schema = schema_of(key)
    if names := schema.get("enum"):
        wrong, words = ["magic", 1], [f"'{name}'" for name in names]
    else:
        wrong, words = (
            [schema["minimum"] - 1, schema["maximum"] + 1],
            [f"{schema[end]:g}" for end in ("minimum", "maximum")],
        )
    for value in wrong:
        test_a_bad_value_is_one_line_with_key_value_and_range(f"{key}={value}", key, [str(value), *words])


@pytest.mark.parametrize("key", [key for key in flatten(BASE) if schema_of(key).get("type") == "boolean"])
def test_a_flag_is_true_or_false(key: str) -> None:
    test_a_bad_value_is_one_line_with_key_value_and_range(f"{key}=1", key, ["1", "true or false"])


def test_a_lens_of_too_many_vertices_is_one_line() -> None:
    with pytest.raises(SpecError, match=r"^optics\.vertices_per_pixel: 8 with 2048 .* 16384 vertices; .* 8192$"):
        resolve_spec(overrides=["image.pixels=2048", "optics.vertices_per_pixel=8"])
    with pytest.raises(SpecError, match=r"and creases makes a lens of 16384"):
        resolve_spec(overrides=["image.pixels=4096", "optics.creases=true"])


def test_the_lens_is_shaped_for_the_ball_that_finishes_it() -> None:
    """It stands in spec.json as a figure, so that another ball for the same lens asks for no other lens."""
    assert resolve_spec().optics.min_radius_mm == 0.5
    assert resolve_spec(overrides=["passes.2.radius_mm=2"]).optics.min_radius_mm == 2.0
    assert resolve_spec(overrides=["optics.min_radius_mm=0"]).optics.min_radius_mm == 0.0
    assert resolve_spec(overrides=["optics.creases=true"]).optics.min_radius_mm == 0.0
    leaves_stock = resolve_spec(overrides=["passes=[{radius_mm=2, pitch_mm=1, stock_to_leave_mm=0.1}]"])
    assert leaves_stock.optics.min_radius_mm == 2.0


def test_another_ball_for_an_earlier_lens_does_not_ask_for_another_lens(tmp_path: Path) -> None:
    stored(tmp_path)
    assert resolve_for_lens(tmp_path, overrides=["passes.2.radius_mm=1"]).spec.optics.min_radius_mm == 0.5


def test_what_a_source_leaves_open_is_filled_in() -> None:
    sun = resolve_spec(overrides=["optics.light.kind=sun"]).optics.light
    lamp = resolve_spec(overrides=["optics.light={kind='point', distance_mm=500}"]).optics.light
    assert (sun.size_deg, sun.size_mm, sun.distance_mm) == (0.53, None, None)
    assert (lamp.size_deg, lamp.size_mm, lamp.distance_mm) == (None, 0.0, 500.0)


@given(st.integers(3, 24), st.floats(0.5, 1.0), st.booleans())
def test_regular_outlines_are_taken_whichever_way_they_turn(corners: int, size: float, clockwise: bool) -> None:
    angles = [2 * pi * k / corners for k in range(corners)]
    outline = [[50 + 50 * size * cos(a), 50 + 50 * size * sin(a)] for a in angles][:: -1 if clockwise else 1]
    optics = resolve_spec(base={"optics": {"outline": outline}}).optics
    assert optics.outline_mm is not None
    area = sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise([*optics.outline_mm, optics.outline_mm[0]])) / 2
    assert area == pytest.approx(corners / 2 * (50 * size) ** 2 * sin(2 * pi / corners), rel=1e-9)


def test_an_outline_that_crosses_itself_at_a_corner_is_refused() -> None:
    hourglass = [[0, 0], [100, 100], [0, 100], [50, 50], [100, 0]]
    with pytest.raises(SpecError, match="cross"):
        resolve_spec(base={"optics": {"outline": hourglass}})


def test_several_bad_values_are_one_line_each() -> None:
    with pytest.raises(SpecError) as caught:
        resolve_spec(overrides=["optics.width_mm=-1", "image.tone=log"])
    assert [key for key, _ in caught.value.problems] == ["image.tone", "optics.width_mm"]


def test_defaults_make_a_complete_job() -> None:
    spec = resolve_spec()
    assert (spec.image.pixels, spec.pixel_rows, spec.optics.screen_size_mm) == (512, 512, (100.0, 100.0))
    assert [(row.radius_mm, row.pitch_mm, row.stock_to_leave_mm) for row in spec.passes] == [
        (3.0, 0.5, 0.2),
        (0.5, 0.05, 0.03),
        (0.5, 0.02, 0.0),
    ]
    assert [row.name for row in spec.passes] == ["rough", "rough", "finish"]
    assert all(row.feed_mm_per_min and row.plunge_mm_per_min and row.spindle_rpm for row in spec.passes)
    assert all(row.step_down_mm for row in spec.passes)


@pytest.mark.parametrize("preset", ["paper", "draft"])
@pytest.mark.parametrize("profile", ["grbl", "grbl-3018"])
def test_a_resolved_spec_resolves_to_itself(preset: str, profile: str) -> None:
    """spec.json is complete: reading it back changes nothing, so that a job can be repeated."""
    spec = resolve_spec(preset=preset, overrides=[f"machine.profile={profile}", "optics.screen_width_mm=50"])
    stored = json.loads(json.dumps(spec.plain()))
    assert resolve_spec(base=stored) == spec
    assert validate_spec(stored) == spec


def test_filled_in_speeds_stay_within_the_mill() -> None:
    for row in resolve_spec(overrides=["machine.profile=grbl-3018"]).passes:
        assert row.spindle_rpm is not None
        assert row.feed_mm_per_min is not None
        assert row.spindle_rpm <= 10_000
        assert row.feed_mm_per_min <= 1000


def test_a_slower_spindle_takes_the_feed_down_with_it() -> None:
    fast = resolve_spec().passes[2]
    slow = resolve_spec(overrides=["machine.profile=grbl-3018"]).passes[2]
    assert fast.feed_mm_per_min is not None
    assert fast.spindle_rpm is not None
    assert slow.feed_mm_per_min == pytest.approx(fast.feed_mm_per_min * 10_000 / fast.spindle_rpm, abs=0.5)


@pytest.mark.parametrize(
    ("overrides", "preset", "process"),
    [
        ([], "recommended", "best"),
        (["optics.width_mm=40", "plan.hours=3"], "recommended", "best"),
        (["finish.process=felt"], "recommended", "felt"),
        (["finish.process=none"], "recommended", "none"),
        (["optics.polish=true"], "recommended", "best"),
        (["preset=draft"], "draft", "none"),
        (["passes.2.pitch_mm=0.1"], "paper", "none"),
    ],
)
def test_who_says_nothing_of_passes_gets_the_best_of_the_mill(
    overrides: list[str], preset: str, process: str, tmp_path: Path
) -> None:
    said: dict[str, Any] = {"file": None, "preset": None, "overrides": overrides}
    spec = resolve_spec(**said, base=default_layer(**said))
    assert (spec.preset, spec.finish.process) == (preset, process)
    (tmp_path / "job.toml").write_text("")
    for told in ({"file": tmp_path / "job.toml"}, {"preset": "draft"}):
        assert default_layer(**{**said, **told}) == {}


def test_order_of_precedence_is_file_preset_set(tmp_path: Path) -> None:
    file = tmp_path / "job.toml"
    optics, row = "[optics]\nwidth_mm = 30\nheight_mm = 20\n", "[[passes]]\nradius_mm = 1\npitch_mm = 0.5\n"
    file.write_text(f'preset = "draft"\n{optics}{row}')
    assert [row.radius_mm for row in resolve_spec(file=file).passes] == [1.0]
    file.write_text(f'preset = "draft"\n{optics}')
    spec = resolve_spec(file=file, preset="paper", overrides=["optics.width_mm=40", "passes.2.pitch_mm=0.1"])
    assert (spec.optics.width_mm, spec.optics.height_mm) == (40.0, 20.0)
    assert [row.pitch_mm for row in spec.passes] == [0.5, 0.05, 0.1]
    assert resolve_spec(overrides=["passes.1.pitch_mm=0.2", "preset=draft"]).passes[1].pitch_mm == 0.2


def test_toml_and_json_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text("[image]\npixels = 64\n[machine]\ntravel_mm = [200, 200, 60]\n")
    (tmp_path / "a.json").write_text('{"image": {"pixels": 64}, "machine": {"travel_mm": [200, 200, 60]}}')
    assert resolve_spec(file=tmp_path / "a.toml") == resolve_spec(file=tmp_path / "a.json")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.toml", b"[image\n", "not valid TOML"),
        ("a.json", b"{", "not valid JSON"),
        ("a.json", b"[1]", "table of keys"),
        ("a.json", b"[" * 100_000, "not valid JSON"),
        ("a.toml", b"\xff\xfe\x00", "UTF-8"),
        ("a.json", b'{"image": {"pixels": ' + b"9" * 5000 + b"}}", "not valid JSON"),
        ("a.toml", b"a = " + b"9" * 5000, "not valid TOML"),
        ("a.toml", b"#" * 1_000_001, "at most 1000000 bytes"),
    ],
)
def test_a_damaged_spec_file_is_one_line(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SpecError) as caught:
        resolve_spec(file=tmp_path / name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_spec_file_without_an_end_is_refused() -> None:
    with pytest.raises(SpecError, match="/dev/zero: is too large"):
        resolve_spec(file=Path("/dev/zero"))


def test_a_number_of_thousands_of_digits_is_no_number() -> None:
    with pytest.raises(SpecError, match=r"optics\.width_mm: '9999"):
        resolve_spec(overrides=["optics.width_mm=" + "9" * 5000])


def test_a_missing_spec_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match="no such file"):
        resolve_spec(file=tmp_path / "none.toml")


def test_the_screen_follows_the_aperture_s_proportion() -> None:
    spec = resolve_spec(overrides=["optics.width_mm=80", "optics.height_mm=40", "optics.screen_width_mm=160"])
    assert spec.optics.screen_size_mm == (160.0, 80.0)
    assert spec.pixel_rows == 256
    tall = resolve_spec(overrides=["optics.width_mm=80", "optics.height_mm=40", "optics.screen_height_mm=80"])
    assert tall.optics.screen_size_mm == (160.0, 80.0)


@given(st.floats(min_value=0.5, max_value=2000, allow_nan=False))
def test_every_number_in_range_is_taken_as_it_is(value: float) -> None:
    overrides = [f"optics.width_mm={value!r}", f"optics.height_mm={value!r}", "machine.travel_mm=[3000, 3000, 80]"]
    assert resolve_spec(overrides=overrides).optics.width_mm == value


@given(st.one_of(st.floats(max_value=0.4999), st.floats(min_value=2000.001), st.just(float("nan"))))
def test_every_number_out_of_range_is_refused(value: float) -> None:
    with pytest.raises(SpecError, match=r"^optics\.width_mm: .*a number from 0\.5 to 2000 mm$"):
        resolve_spec(overrides=[f"optics.width_mm={value!r}"])


@given(st.text(max_size=40), st.text(max_size=40))
def test_no_override_whatever_it_says_is_more_than_one_line_or_a_traceback(key: str, value: str) -> None:
    try:
        resolve_spec(overrides=[f"{key}={value}"])
    except SpecError as error:
        assert len(str(error).splitlines()) == 1


@given(st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=5), lambda x: st.lists(x, max_size=3)))
def test_no_value_of_any_kind_ends_in_anything_but_a_spec_error(value: object) -> None:
    tables: list[dict[str, object]] = [
        {"passes": value}, {"machine": {"travel_mm": value}}, {"image": value}, {"passes": [value]},
        {"optics": {"outline": value}}, {"optics": {"light": value}}, {"optics": {"light": {"profile": value}}},
    ]  # fmt: skip
    for table in tables:
        try:
            resolve_spec(base=table)
        except SpecError as error:
            assert str(error)


def test_an_override_never_sets_a_second_key() -> None:
    assert parse_override("a.b=1\nc=2") == (["a", "b"], "1\nc=2")


def stored(folder: Path, *overrides: str) -> JobSpec:
    spec = resolve_spec(overrides=overrides)
    (folder / "spec.json").write_text(json.dumps(spec.plain()))
    return spec


def test_another_mill_for_an_earlier_job_chooses_its_speeds_anew(tmp_path: Path) -> None:
    """24 000 rpm stand in spec.json as the first mill's start value; the second one turns 10 000 at most."""
    stored(tmp_path)
    other = ["machine.profile=grbl-3018"]
    assert resolve_for_lens(tmp_path, overrides=other) == resolve_job(overrides=other)
    assert resolve_for_lens(tmp_path) == resolve_job()


def test_another_ball_for_an_earlier_job_chooses_its_feed_anew(tmp_path: Path) -> None:
    stored(tmp_path)
    other = ["passes.2.radius_mm=1.5"]
    assert resolve_for_lens(tmp_path, overrides=other).spec.passes[2] == resolve_spec(overrides=other).passes[2]


def test_speeds_that_a_person_chose_stay_with_the_job(tmp_path: Path) -> None:
    spec = stored(tmp_path, "passes.1.spindle_rpm=9000", "passes.2.feed_mm_per_min=123", "passes.0.step_down_mm=0.7")
    again = resolve_for_lens(tmp_path).spec
    assert again == spec
    assert (again.passes[1].spindle_rpm, again.passes[2].feed_mm_per_min, again.passes[0].step_down_mm) == (
        9000, 123, 0.7,
    )  # fmt: skip
    stored(tmp_path, "passes.1.spindle_rpm=20000")
    with pytest.raises(SpecError, match=r"passes\.1\.spindle_rpm: 20000 is not allowed; .*10000 rpm"):
        resolve_for_lens(tmp_path, overrides=["machine.profile=grbl-3018"])


def test_programs_are_for_the_lens_that_exists() -> None:
    stored = resolve_spec()
    require_same_lens(stored, resolve_spec(overrides=["passes.2.pitch_mm=0.1", "stock.thickness_mm=50"]))
    with pytest.raises(SpecError, match=r"optics\.throw_mm: .*100"):
        require_same_lens(stored, resolve_spec(overrides=["optics.throw_mm=120"]))
