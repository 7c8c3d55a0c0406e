"""A job that does not fit between the table and the head of its mill is refused when it is submitted, by the key at
fault, with what would fit; and what is offered does fit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from machines.profile import load_profile, profile_names
from service.errors import SpecError
from service.job.spec.envelope import envelope_of, list_reaches
from service.job.spec.loading import resolve_job

Base = dict[str, Any]


def refused(base: Base, *, preset: str | None = None) -> SpecError:
    with pytest.raises(SpecError) as caught:
        resolve_job(preset=preset, base=base)
    return caught.value


def with_value(base: Base, key: str, value: float) -> Base:
    table, name = key.split(".")
    return base | {table: base.get(table, {}) | {name: value}}


@pytest.mark.parametrize("preset", ["paper", "recommended"])
@pytest.mark.parametrize(
    ("base", "key", "words"),
    [
        ({"stock": {"thickness_mm": 200}}, "stock.thickness_mm", "the collet of grbl goes up to 100 mm"),
        (
            {"machine": {"profile": "grbl-3018"}, "optics": {"width_mm": 170, "height_mm": 170},
             "stock": {"margin_mm": 14}},
            "optics.height_mm", "the block is 198 mm along Y",
        ),
        ({"machine": {"gantry_mm": 40}}, "stock.thickness_mm", "under the gantry of grbl there are 40 mm"),
        ({"stock": {"base_mm": 60}}, "stock.base_mm", "machine.bed_to_collet_mm"),
        ({"stock": {"base_mm": 0, "cut_out": {"through_mm": 0.5}}}, "stock.base_mm", "allowed: at least 0.5"),
        ({"stock": {"thickness_mm": 3, "base_mm": 0},
          "machine": {"travel_mm": [300, 300, 50], "bed_to_collet_mm": 100}},
         "stock.base_mm", "comes down to 50 mm over the table"),
        ({"stock": {"clamping": "strap-m8", "margin_mm": 20, "thickness_mm": 20}, "machine": {"safe_z_mm": 5}},
         "machine.safe_z_mm", "at least 33"),
        ({"stock": {"cut_out": {"flute_length_mm": 12}}}, "stock.cut_out.flute_length_mm", "the shank would rub"),
        ({"stock": {"clamping": "strap-m6", "margin_mm": 20, "face": {}}}, "stock.clamping", "held from below"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_name(base: Base, key: str, words: str, preset: str) -> None:
    error = refused(base, preset=preset)
    rows = {row["field"].removeprefix("spec."): row for row in error.rows()}
    assert key in rows and words in str(error)
    use = rows[key].get("use")
    if use is not None and key.count(".") == 1:  # what is offered is enough
        resolve_job(preset=preset, base=with_value(base, key, use))


def test_a_stated_stick_out_that_is_too_short_is_refused_and_the_least_is_not() -> None:
    rows = [{"radius_mm": 3.0, "pitch_mm": 0.5, "flute_length_mm": 15.0, "stick_out_mm": 12.0}]
    error = refused({"passes": rows})
    assert "passes.0.stick_out_mm: 12 is too short" in str(error)
    resolve_job(base={"passes": [rows[0] | {"stick_out_mm": error.rows()[0]["use"]}]})


def test_a_height_that_is_a_guess_is_asked_for_before_a_program_goes_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    error = refused({"machine": {"profile": "okuma-osp"}})
    assert "machine.top_z_mm: 460 is a guess" in str(error) and "top_z_mm = ..." in str(error)
    assert resolve_job(base={"machine": {"profile": "okuma-osp", "top_z_mm": 455}}).machine.top_z_mm == 455
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    (tmp_path / "machines").mkdir()
    (tmp_path / "machines" / "ours.toml").write_text('extends = "okuma-osp"\ntop_z_mm = 455\n')
    assert resolve_job(base={"machine": {"profile": "ours"}}).machine.top_z_mm == 455
    (tmp_path / "machines" / "ours.toml").write_text('extends = "okuma-osp"\nsafe_z_mm = 12\n')
    refused({"machine": {"profile": "ours"}})


@pytest.mark.parametrize("clamping", ["strap-m6", "strap-m8", "strap-m10"])
def test_rapids_cross_over_named_clamps_and_tools_stick_out_for_them(clamping: str) -> None:
    job = resolve_job(base={"stock": {"clamping": clamping, "margin_mm": 15, "thickness_mm": 15}})
    envelope = envelope_of(job.spec, job.machine)
    high_mm = max(clamp.height_mm for clamp in envelope.clamps)
    assert job.machine.safe_z_mm == high_mm + 1
    reach = list_reaches(job.spec, depth_mm=8.0)["passes.0"]
    assert envelope.least_stick_out_mm(reach) == pytest.approx(8 + high_mm + 2)


@pytest.mark.parametrize("profile", profile_names(()))
def test_every_built_in_mill_knows_its_table_and_its_head(profile: str) -> None:
    mill = load_profile(profile, ())
    assert mill.table_mm is not None and mill.bed_to_collet_mm is not None and mill.nose_mm
    assert mill.bed_to_collet_mm >= mill.travel_mm[2]  # the collet never goes into the table
    assert all(table >= 0.8 * travel for table, travel in zip(mill.table_mm, mill.travel_mm, strict=False))


def test_figures_of_another_travel_are_not_kept() -> None:
    """Nothing is known of the head and the table of a mill whose travel is not that of its profile."""
    machine = resolve_job(base={"machine": {"travel_mm": [500, 300, 120]}}).machine
    assert (machine.table_mm, machine.bed_to_collet_mm, machine.gantry_mm, machine.guesses) == (None, None, None, ())
    assert resolve_job(base={"machine": {"travel_mm": [500, 300, 80]}}).machine.bed_to_collet_mm == 100
