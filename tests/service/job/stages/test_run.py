"""What a stage does with its order: refusals in the person's words, and nothing left behind."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from service.errors import FailedError, InputError, PictureError, ServiceError
from service.job.stages.order import FileRef, PictureLimits, StageOrder, StageResult, merge_notes
from service.job.stages.run import run_order
from tests.service.job.stages.jobs import StagedJob, save_picture, staged_job, tiny_spec


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> StagedJob:
    return staged_job(tmp_path_factory.mktemp("job")).run_all(until="check", without=("caustic",))


def silent(_share: float) -> None: ...


def refused(job: StagedJob, order: StageOrder, kind: type[ServiceError]) -> str:
    """The words of the refusal: one or more lines, no path, no hash; and nothing is left."""
    with pytest.raises(kind) as caught:
        run_order(order, job.store, silent)
    words = str(caught.value)
    assert str(job.scratch) not in words
    assert job.image_sha256[:8] not in words
    assert not Path(order.scratch).exists()
    return words


def with_picture(job: StagedJob, path: Path) -> StageOrder:
    return replace(job.order("image"), image_sha256=job.store.put_file(path).sha256, image_name="holiday.png")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "holiday.png: the file is empty"),
        (b"no picture", "holiday.png: not a picture"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "holiday.png: not a picture"),
    ],
)
def test_what_is_no_picture_is_refused_by_its_name(job: StagedJob, tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "upload"
    path.write_bytes(content)
    assert refused(job, with_picture(job, path), PictureError).startswith(words)


def test_a_damaged_and_a_black_picture_are_refused_by_their_name(job: StagedJob, tmp_path: Path) -> None:
    data = save_picture(tmp_path / "whole.png").read_bytes()
    (tmp_path / "cut").write_bytes(data[: len(data) // 2])
    assert refused(job, with_picture(job, tmp_path / "cut"), PictureError).startswith("holiday.png: ")
    Image.new("L", (20, 20)).save(tmp_path / "black.png")
    words = refused(job, with_picture(job, tmp_path / "black.png"), PictureError)
    assert words == "holiday.png: the picture is black everywhere, there is no light to aim"


def test_a_link_that_starves_the_mill_is_told_with_figures(tmp_path: Path) -> None:
    """The feed it carries is that of way and time; one that carries all of it is not told of; both once."""
    slow = staged_job(tmp_path, "machine.lines_per_s=20").run_all(until="check", without=("caustic",))
    slow.run("check")
    row, notes = slow.report["passes"][1], merge_notes(one.notes for one in slow.results.values())["passes"]
    (told,) = (note for note in notes if note.startswith(row["file"]) and "link" in note)
    assert any("chips are too thin" in note and "waits for lines" in note for note in notes)
    found = re.search(r"F(\d+), but 20 lines and \d+ bytes a second carry F(\d+) .* (\d+) lines a second would", told)
    assert found is not None, told
    asked, carried, enough = map(float, found.groups())
    assert asked == row["settings"]["feed_mm_per_min"]
    assert carried / 60 == pytest.approx(row["path_length_mm"] / row["time_s"], rel=0.01)
    slow.spec = tiny_spec(f"machine.lines_per_s={3 * enough}")
    assert not any(row["file"] in note and "link" in note for note in slow.run("check").notes.get("passes", ()))


def test_the_limits_of_the_order_hold(job: StagedJob, tmp_path: Path) -> None:
    order = replace(job.order("image"), limits=PictureLimits(max_pixels=1000))
    assert refused(job, order, PictureError) == "blob.png: 48 x 40 pixels are 1920; allowed: at most 1000"
    Image.new("L", (20, 20), 9).save(tmp_path / "p.pcx")
    other = replace(with_picture(job, tmp_path / "p.pcx"), limits=order.limits)
    assert "not a picture" in refused(job, other, PictureError)


def test_a_file_that_the_store_has_lost_is_named(job: StagedJob) -> None:
    order = job.order("heightfield")
    gone = {**order.inputs, ".heights.npz": FileRef("0" * 64, 1)}
    words = refused(job, replace(order, inputs=gone), FailedError)
    assert words == ".heights.npz: it is no longer in the artifact store"
    words = refused(job, replace(job.order("image"), image_sha256="0" * 64), FailedError)
    assert words == "blob.png: it is no longer in the artifact store"


def test_a_damaged_input_is_a_failure_not_the_persons_fault(job: StagedJob, tmp_path: Path) -> None:
    (tmp_path / "damaged").write_bytes(b"PK nonsense")
    ref = FileRef(job.store.put_file(tmp_path / "damaged").sha256, 11)
    order = job.order("caustic")
    words = refused(job, replace(order, inputs={**order.inputs, "map.npz": ref}), FailedError)
    assert words.startswith("map.npz: not a file of this program")


@pytest.mark.parametrize(
    ("values", "stage", "words"),
    [
        (("stock.thickness_mm=2.1",), "heightfield", "stock.thickness_mm"),
        (("machine.travel_mm=[200,200,5.15]",), "fit", "machine.travel_mm.2"),
    ],
)
def test_what_does_not_fit_names_the_key(
    job: StagedJob, tmp_path: Path, values: tuple[str, ...], stage: str, words: str
) -> None:
    other = staged_job(tmp_path, *values)
    order = replace(other.order(stage), inputs=job.outputs)
    other.store = job.store
    assert words in refused(other, order, InputError)


def test_a_program_that_is_not_the_one_that_was_checked_ends_the_job(job: StagedJob, tmp_path: Path) -> None:
    name = "pass-2-finish.nc"
    path = tmp_path / "changed.nc"
    path.write_bytes(job.bytes(name).replace(b"X2", b"X1", 1))
    order = job.order("check")
    ref = FileRef(job.store.put_file(path).sha256, path.stat().st_size)
    words = refused(job, replace(order, inputs={**order.inputs, name: ref}), FailedError)
    assert words.startswith(f"{name}: is not the program that was checked")


@pytest.mark.parametrize(("line", "words"), [(b"G2X1I1\n", "centre"), (b"X900\n", "travel"), (b"M7\n", "")])
def test_a_program_that_the_mill_may_not_run_ends_the_job(
    job: StagedJob, tmp_path: Path, line: bytes, words: str
) -> None:
    """Pre-flight judges for itself: here the row has the hash of the bad program."""
    name = "pass-1-rough.nc"
    lines = job.bytes(name).splitlines(keepends=True)
    path = tmp_path / "bad.nc"
    path.write_bytes(b"".join([*lines[:20], line, *lines[20:]]))
    order = job.order("check")
    ref = FileRef(job.store.put_file(path).sha256, path.stat().st_size)
    rows = [{**row, "sha256": ref.sha256} if row["file"] == name else row for row in order.report["passes"]]
    bad = replace(order, inputs={**order.inputs, name: ref}, report={**order.report, "passes": rows})
    if words:
        assert words in refused(job, bad, FailedError)
    else:  # allowed, with a remark
        assert run_order(bad, job.store, silent).outputs


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit, ZeroDivisionError])
def test_scratch_is_gone_whatever_happens(job: StagedJob, error: type[BaseException]) -> None:
    order = job.order("map")

    def fail(share: float) -> None:
        if share > 0:
            assert Path(order.scratch).is_dir()
            raise error

    with pytest.raises(error):
        run_order(order, job.store, fail)
    assert not Path(order.scratch).exists()


def test_what_an_earlier_try_left_in_scratch_does_not_get_into_the_outputs(job: StagedJob) -> None:
    order = job.order("irradiance")
    Path(order.scratch).mkdir(parents=True)
    (Path(order.scratch) / "left.png").write_bytes(b"left")
    assert run_order(order, job.store, silent).outputs == job.results["irradiance"].outputs


def test_a_folder_that_cannot_be_made_is_one_line(job: StagedJob, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    order = replace(job.order("irradiance"), scratch=str(tmp_path / "file" / "here"))
    with pytest.raises(FailedError, match="cannot make a folder to work in: a part of the path is not a folder"):
        run_order(order, job.store, silent)


def test_stages_do_not_write_to_what_lies_in_the_store(job: StagedJob) -> None:
    for name, ref in job.outputs.items():
        assert job.store.path(ref.sha256).stat().st_mode & 0o222 == 0, name  # type: ignore[union-attr]


NAMES = st.text(max_size=20)
REFS = st.builds(FileRef, NAMES, st.integers(0))


@pytest.mark.thorough
@given(st.dictionaries(NAMES, REFS), st.dictionaries(NAMES, st.lists(NAMES)), st.integers(1))
def test_orders_and_results_survive_json(files: dict[str, FileRef], notes: dict[str, list[str]], number: int) -> None:
    order = StageOrder(
        job_id="j", attempt=number, stage="map", spec={"a": [1.5, None]}, figures="{}", image_sha256="0",
        image_name="ä", scratch="/s", inputs=files, report={"optics": {"history": []}}, notes=notes,
        limits=PictureLimits(max_pixels=number),
    )  # fmt: skip
    result = StageResult(outputs=files, report={}, notes=notes, seconds=0.5, peak_rss_mb=1.0)
    assert StageOrder.from_plain(json.loads(json.dumps(order.plain()))) == order
    assert StageResult.from_plain(json.loads(json.dumps(result.plain()))) == result


def test_a_stage_that_does_not_exist_is_a_mistake_of_the_caller(job: StagedJob) -> None:
    run: Callable[[], StageResult] = lambda: run_order(replace(job.order("map"), stage="melt"), job.store, silent)  # noqa: E731
    with pytest.raises(KeyError):
        run()
