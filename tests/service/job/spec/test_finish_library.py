"""The finish library: laws of each process, what a shop may write of its own, and what a person is told."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import InputError
from service.job.planning.finish_choice import list_finishings
from service.job.report.finishing import make_finishing_card
from service.job.spec import finish_library
from service.job.spec.finish_library import AREA_MM2, Process, instruct_finishing, load_processes, wavelength_mm
from service.job.spec.lens_task import finish_of
from service.job.spec.loading import resolve_job
from service.job.stages.table import facts_of
from tests.service.job.report.sheet import render_report

SHIPPED = finish_library.built_in_processes()
BY_HAND = [process for name, process in SHIPPED.items() if name != "none"]
GOOD = '[buffing]\ntitle = "Buffing"\norder = 1\nk0_rad_per_mm = 5\ndefault_minutes = 20\n'
AREA = st.floats(100.0, 40_000.0)


def library(folder: Path, text: str) -> Path:
    path = folder / "finishing.toml"
    path.write_text(text)
    return path


def test_the_shipped_processes_have_the_orders_of_their_physics() -> None:
    orders = {name: process.order for name, process in SHIPPED.items()}
    assert orders == {"none": 2, "sanding": 2, "felt": 1, "lacquer": 4, "flame": 1, "vapour": 4}


@pytest.mark.parametrize("process", BY_HAND, ids=lambda process: process.name)
def test_a_process_tells_a_workshop_what_to_do(process: Process) -> None:
    """Steps, when to stop, what not to do, where the figures come from; the back and cleaning are not forgotten."""
    assert len(process.steps) >= 4 and len(process.donts) >= 3 and process.needs
    assert process.removal and process.when_to_stop and process.law
    words = " ".join(process.steps)
    assert "back" in words
    assert "Wash" in words
    assert all(sentence.endswith(".") for sentence in (*process.steps, *process.donts))
    assert process.minutes_range[0] < process.default_minutes < process.minutes_range[1]


@pytest.mark.parametrize("process", BY_HAND, ids=lambda process: process.name)
@given(minutes=st.floats(0.1, 500.0), longer=st.floats(1.01, 20.0), area_mm2=AREA)
def test_a_longer_finish_levels_longer_waves(process: Process, minutes: float, longer: float, area_mm2: float) -> None:
    """k0 falls with the minutes by the law's power, whatever was done before; the inverse finds the minutes again."""
    before, after = (process.k0_rad_per_mm(part * minutes, area_mm2) for part in (1.0, longer))
    assert after < before
    assert before / after == pytest.approx(longer**process.k0_exponent)
    assert process.minutes_to(after, area_mm2) == pytest.approx(longer * minutes)


@given(times=st.floats(0.1, 10.0), area_mm2=AREA)
def test_work_by_hand_is_shared_out_over_the_area(times: float, area_mm2: float) -> None:
    """A lens of twice the area takes twice the minutes for the same finish; a dip takes the same."""
    for process in BY_HAND:
        minutes = process.minutes(area_mm2) * times
        larger = minutes * (2 if process.by_area else 1)
        assert process.k0_rad_per_mm(larger, 2 * area_mm2) == pytest.approx(process.k0_rad_per_mm(minutes, area_mm2))
        assert process.depth_after_um(larger, 2 * area_mm2) == pytest.approx(process.depth_after_um(minutes, area_mm2))
    assert {process.name for process in BY_HAND if process.by_area} == {"sanding", "felt", "flame"}


def test_the_default_minutes_give_the_figures_of_the_library() -> None:
    for process in BY_HAND:
        assert process.k0_rad_per_mm(process.minutes(AREA_MM2), AREA_MM2) == process.default_k0_rad_per_mm
        assert process.depth_after_um(process.minutes(AREA_MM2), AREA_MM2) == process.depth_um


def test_constants_follow_from_the_physics_they_name() -> None:
    """Figures of the laws, in SI: an elastic pad, a levelling film, a soft layer."""
    felt, lacquer, flame, vapour = (SHIPPED[name] for name in ("felt", "lacquer", "flame", "vapour"))
    pressure_mpa, modulus_mpa = 0.02, 1.0
    pad_k0 = 2 * pressure_mpa / (1e-3 * felt.depth_um * modulus_mpa)
    assert felt.default_k0_rad_per_mm == pytest.approx(pad_k0, rel=0.02)
    film = [(lacquer, 1.0, 10e-6, 60 * 3), (vapour, 20.0, 20e-6, 60 * 4)]
    for process, viscosity, thickness_m, seconds in film:
        k0_per_m = (3 * viscosity / (0.03 * thickness_m**3 * seconds)) ** 0.25
        assert process.default_k0_rad_per_mm == pytest.approx(k0_per_m / 1000, rel=0.02)
    assert flame.default_k0_rad_per_mm == pytest.approx(2 * 180 / (0.03 * 1.2) / 1000, rel=0.02)


def test_no_finish_changes_nothing() -> None:
    none = SHIPPED["none"]
    assert none.k0_rad_per_mm(30.0, AREA_MM2) == math.inf
    assert none.depth_after_um(30.0, AREA_MM2) == 0.0
    assert none.minutes_to(5.0, AREA_MM2) == math.inf
    assert SHIPPED["felt"].k0_rad_per_mm(0.0, AREA_MM2) == math.inf


def test_a_shop_adds_its_own_process_and_replaces_another(tmp_path: Path) -> None:
    own = library(tmp_path, GOOD + '[felt]\ntitle = "Our felt"\norder = 1\nk0_rad_per_mm = 2.5\ndefault_minutes = 30\n')
    found = load_processes(own)
    assert set(found) == {*SHIPPED, "buffing"}
    assert (found["felt"].title, found["felt"].steps) == ("Our felt", ())
    assert found["sanding"] == SHIPPED["sanding"]
    buffing = found["buffing"]
    assert (buffing.k0_exponent, buffing.minutes_range, buffing.pad_mm) == (1.0, (5.0, 80.0), math.inf)


def test_the_own_file_is_found_in_the_configuration_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    assert set(load_processes()) == set(SHIPPED)
    library(tmp_path, GOOD)
    assert "buffing" in load_processes()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GOOD + "colour = 1\n", ["buffing", "colour = 1", "order"]),
        (GOOD.replace("order = 1", "order = 0"), ["order = 0", "0.5 to 8"]),
        (GOOD.replace("k0_rad_per_mm = 5", "k0_rad_per_mm = 0"), ["k0_rad_per_mm = 0", "0.3 rad/mm"]),
        (GOOD.replace("k0_rad_per_mm = 5", "k0_rad_per_mm = nan"), ["k0_rad_per_mm = nan", "0.3 rad/mm"]),
        (GOOD.replace("default_minutes = 20", "default_minutes = 0"), ["default_minutes = 0", "more than 0"]),
        (GOOD.replace("default_minutes = 20\n", ""), ["default_minutes", "missing"]),
        (GOOD + "minutes_range = [30, 40]\n", ["default_minutes = 20", "30 to 40"]),
        (GOOD + "minutes_range = [40, 30]\n", ["minutes_range = [40, 30]", "[least, most]"]),
        (GOOD + 'minutes_range = "often"\n', ["minutes_range = 'often'", "[least, most]"]),
        (GOOD + "by_area = 1\n", ["by_area = 1", "true or false"]),
        (GOOD + 'steps = "rub"\n', ["steps = 'rub'", "sentences"]),
        (GOOD.replace("[buffing]", "[Buff_ing]"), ["Buff_ing", "lower-case letters"]),
        ("felt = 3\n", ["felt", "[felt]"]),
        ("[felt\n", ["not valid TOML"]),
    ],
)
def test_a_bad_library_is_one_line_with_file_key_value_and_allowed(tmp_path: Path, text: str, words: list[str]) -> None:
    path = library(tmp_path, text)
    with pytest.raises(InputError) as caught:
        load_processes(path)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(str(path))
    assert all(word in line for word in words), line


@given(st.sampled_from([0.1, 0.5, 0.9]), st.floats(0.5, 30.0), st.sampled_from([1.0, 2.0, 4.0]))
def test_a_wave_of_that_length_keeps_that_share(share: float, k0_rad_per_mm: float, order: float) -> None:
    k_rad_per_mm = 2 * math.pi / wavelength_mm(share, k0_rad_per_mm, order)
    assert math.exp(-((k_rad_per_mm / k0_rad_per_mm) ** order)) == pytest.approx(share)


def told(process: str = "felt", **figures: Any) -> dict[str, Any]:
    found = instruct_finishing({"process": process, **figures}, SHIPPED, area_mm2=2500.0)
    assert found is not None
    return found


def test_instructions_take_the_job_s_own_figures_and_the_rest_from_the_library() -> None:
    usual, own = told(), told(minutes=20.0, k0_rad_per_mm=2.0, order=1.5)
    assert usual["minutes"] == pytest.approx(10.0)
    assert usual["k0_rad_per_mm"] == pytest.approx(3.1)
    assert (own["k0_rad_per_mm"], own["order"]) == (2.0, 1.5)
    assert own["depth_um"] == pytest.approx(2 * usual["depth_um"])
    assert own["levelled_mm"] == pytest.approx(wavelength_mm(0.1, 2.0, 1.5))
    assert own["steps"] == list(SHIPPED["felt"].steps)
    assert instruct_finishing({"process": "none"}, SHIPPED, area_mm2=1.0) is None
    assert instruct_finishing({}, SHIPPED, area_mm2=1.0) is None
    assert (usual["pad_mm"], told(pad_mm=8.0)["pad_mm"]) == (10.0, 8.0)
    assert "pad_mm" not in told("lacquer") and "pad_mm" not in told("lacquer", pad_mm=5000.0)
    for name in SHIPPED:
        json.dumps(instruct_finishing({"process": name}, SHIPPED, area_mm2=900.0), allow_nan=False)


@pytest.mark.parametrize("name", ["none", "magic"])
def test_figures_without_a_process_are_told_and_that_nobody_knows_how(name: str) -> None:
    found = told(name, k0_rad_per_mm=4.0, order=2.0, minutes=5.0, depth_um=3.0)
    card = make_finishing_card({"finishing": found})
    assert card is not None
    assert card["steps"] == []
    assert any("no library" in sentence for sentence in card["warnings"])
    assert ("Time, the whole lens", "5 min") in card["rows"]


SEEN = {
    "as_milled": {
        "psnr_db": 15.3, "seen_db": 8.0, "ssim": 0.4, "misplaced_light": 0.1, "step_mm": 0.004, "z_noise_mm": 0.001,
        "blur_x_px": 3.0, "blur_y_px": 5.0, "blur_px": 5.8, "slope_rms_mrad": 30.0,
        "psnr_db_designed": 43.0, "seen_db_designed": 38.0,
        "gain_db_without": {},
    },
    "as_finished": {
        "psnr_db": 24.1, "seen_db": 17.0, "ssim": 0.68, "misplaced_light": 0.04, "smallest_detail_mm": 1.12,
    },
}  # fmt: skip
PICTURES = ["caustic-as-milled.png", "caustic-as-finished.png"]


def test_the_sheet_leads_through_the_finish_with_both_pictures() -> None:
    page = render_report({**SEEN, "finishing": told()}, files=PICTURES)
    process = SHIPPED["felt"]
    assert "Finishing by hand: Polishing with felt" in page
    for sentence in (*process.needs, *process.steps, *process.donts, process.removal, process.when_to_stop):
        assert sentence in page
    assert "24.1 dB: plainly the picture" in page and "details from 1.1 mm show" in page
    assert "As finished: likeness (PSNR)" in page
    for name in PICTURES:
        assert page.count(f'src="{name}"') == 2  # at the top, and beside each other
    assert "makes the picture worse" not in page
    assert "Finishing by hand" not in render_report(SEEN, files=PICTURES[:1])


def test_what_the_sheet_says_is_made_anew_when_the_library_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A job's own finish is in its spec by name; other words under that name make another sheet."""
    monkeypatch.setenv("CAUSTICMILL_CONFIG_DIR", str(tmp_path))
    facts = []
    for title in ("Buffing", "Buffing by night"):
        library(tmp_path, GOOD.replace("Buffing", title))
        facts.append(facts_of(resolve_job(overrides=["finish.process=buffing"]))["finish_process"])
    assert facts[0] != facts[1]
    assert facts_of(resolve_job())["finish_process"] is None


def test_a_finish_that_makes_it_worse_is_said_first() -> None:
    worse = {**SEEN, "as_finished": {"psnr_db": 12.0}, "finishing": told()}
    card = make_finishing_card(worse)
    assert card is not None
    assert "12.0 dB instead of 15.3 dB" in card["warnings"][0]
    (outside,) = make_finishing_card({**SEEN, "finishing": told(minutes=0.2)})["warnings"]  # type: ignore[index]
    assert "12 s is outside the known range" in outside


@pytest.mark.parametrize(
    ("overrides", "depth_mm"),
    [
        (["finish.process=felt", "finish.minutes=40"], 0.013),
        (["finish.process=sanding", "finish.minutes=45"], 0.02),
        (["finish.process=lacquer"], None),
        (["finish.process=flame"], None),
        (["finish.process=vapour"], None),
        (["finish.process=felt", "finish.depth_um=0"], None),
        (["finish.k0_rad_per_mm=3", "finish.order=1"], None),
        (["finish.k0_rad_per_mm=3", "finish.order=1", "finish.depth_um=12"], 0.012),
        (["finish.k0_rad_per_mm=3", "finish.order=1", "finish.depth_um=-12"], None),
        (["finish.k0_rad_per_mm=3", "finish.order=1", "finish.depth_um=12", "finish.pad_mm=4000"], None),
    ],
)
def test_a_tool_works_by_contact_and_a_film_everywhere(overrides: list[str], depth_mm: float | None) -> None:
    """A pad or paper with what it takes off; where nothing comes off, or no tool touches the lens, all is levelled."""
    finish = finish_of(resolve_job(preset="draft", overrides=overrides).spec)
    assert finish is not None
    assert finish.depth_mm == (None if depth_mm is None else pytest.approx(depth_mm))


@pytest.mark.parametrize("process", [name for name in SHIPPED if name != "none"])
def test_the_planner_tries_a_finish_by_the_law_of_the_job_it_makes(process: str) -> None:
    job = resolve_job(preset="recommended", overrides=[f"finish.process={process}"])
    for one in list_finishings(job):
        given = [f"finish.process={process}", f"finish.minutes={one.minutes}"]
        assert one.finish == finish_of(resolve_job(preset="draft", overrides=given).spec)
