"""A tiny job, stage by stage through a real artifact store, as a worker runs it (but in this process)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from service.job.picture import OWN_PICTURE
from service.job.spec.loading import resolve_spec
from service.job.spec.model import JobSpec
from service.job.spec.resolve import look_up, with_plan
from service.job.stages.order import FileRef, StageOrder, StageResult, merge_notes, merge_reports
from service.job.stages.run import run_order
from service.job.stages.table import plan, stage_key
from service.store.local import LocalStore

TINY = (  # small balls and a narrow margin: the block, not the lens, is what takes time
    "image.pixels=24", "image.tone=linear", "optics.width_mm=3", "optics.height_mm=3", "optics.throw_mm=20",
    "stock.margin_mm=1.5", "passes.0.radius_mm=1", "passes.0.pitch_mm=0.4",
)  # fmt: skip
SMALL_BALLS = {
    "draft": ("passes.1.radius_mm=1", "passes.1.pitch_mm=0.1"),
    "paper": ("passes.1.pitch_mm=0.2", "passes.2.pitch_mm=0.1"),
}


def tiny_spec(*values: str, preset: str = "draft") -> JobSpec:
    return resolve_spec(preset=preset, overrides=(*TINY, *SMALL_BALLS[preset], *values))


def save_picture(path: Path) -> Path:
    """A soft blob off the middle, 48 x 40: no mirror of it looks the same, and cropping is not stretching."""
    y, x = np.mgrid[0:40, 0:48] / 39
    light = 0.5 + np.exp(-((x - 0.35) ** 2 + (y - 0.25) ** 2) / 0.05)
    Image.fromarray(np.rint(255 * light / light.max()).astype(np.uint8)).save(path)
    return path


@dataclass
class StagedJob:
    """Runs stages one after the other and keeps what they said and made."""

    spec: JobSpec
    store: LocalStore
    image_sha256: str
    scratch: Path
    image_name: str = "blob.png"
    outputs: dict[str, FileRef] = field(default_factory=dict)
    results: dict[str, StageResult] = field(default_factory=dict)
    keys: dict[str, str] = field(default_factory=dict)
    told: dict[str, list[float]] = field(default_factory=dict)  # progress of each stage

    def order(self, stage: str) -> StageOrder:
        return StageOrder(
            job_id="job",
            attempt=1,
            stage=stage,
            spec=self.spec.plain(),
            figures=look_up(self.spec).figures.to_text(),
            image_sha256=self.image_sha256,
            image_name=self.image_name,
            scratch=str(self.scratch / f"job.1.{stage}"),
            limits=OWN_PICTURE,
            inputs=dict(self.outputs),
            report=self.report,
            notes=merge_notes(result.notes for result in self.results.values()),
        )

    def key(self, stage: str) -> str:
        return stage_key(
            stage, look_up(self.spec), image_sha256=self.image_sha256, image_name=self.image_name, outputs=self.outputs
        )

    def run(self, stage: str) -> StageResult:
        self.keys[stage] = self.key(stage)
        order = StageOrder.from_plain(self.order(stage).plain())
        result = run_order(order, self.store, self.told.setdefault(stage, []).append)
        self.take(stage, StageResult.from_plain(result.plain()))
        return result

    def take(self, stage: str, result: StageResult) -> None:
        self.results[stage] = result
        self.outputs |= result.outputs

    def run_all(self, *, until: str | None = None, without: Collection[str] = ()) -> StagedJob:
        """Run all stages, or those before `until`, but for some that none of these needs."""
        stages = plan(self.spec)
        for stage in stages[: stages.index(until) if until else None]:
            if stage not in without:
                self.run(stage)
        return self

    @property
    def report(self) -> dict[str, Any]:
        return merge_reports(result.report for result in self.results.values())

    def bytes(self, name: str) -> bytes:
        return b"".join(self.store.open_range(self.outputs[name].sha256))


def without_light(report: Mapping[str, Any]) -> list[str]:
    """The parts of a report that hold a PSNR and do not say under which light."""

    def has_score(part: Any) -> bool:
        if isinstance(part, Mapping):
            return any("psnr_db" in key or has_score(one) for key, one in part.items())
        return isinstance(part, list) and any(map(has_score, part))

    return [name for name, part in report.items() if has_score(part) and not part.get("light")]


def staged_job(
    folder: Path, *values: str, preset: str = "draft", spec: JobSpec | None = None, **given: Any
) -> StagedJob:
    """A tiny job whose picture is in a new store below `folder`."""
    store = LocalStore(folder / "objects")
    picture = store.put_file(save_picture(folder / "blob.png"))
    return StagedJob(
        spec=spec or tiny_spec(*values, preset=preset),
        store=store,
        image_sha256=picture.sha256,
        scratch=folder / "scratch",
        **given,
    )


def run_job(folder: Path, picture: Path, spec: JobSpec, *, without: Collection[str] = ()) -> StagedJob:
    """A job of any picture, its passes planned on the way, but for some stages that none of the others needs."""
    store = LocalStore(folder / "objects")
    job = StagedJob(spec=spec, store=store, image_sha256=store.put_file(picture).sha256, scratch=folder / "scratch")
    while stage := next((one for one in plan(job.spec) if one not in job.results and one not in without), None):
        job.spec = with_plan(job.spec, job.run(stage).report)
    return job


def hashes(outputs: Mapping[str, FileRef]) -> dict[str, str]:
    return {name: ref.sha256 for name, ref in outputs.items()}
