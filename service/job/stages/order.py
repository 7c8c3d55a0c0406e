"""The order to a stage's process, and its result: plain values that survive JSON, importable without arrays."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from service.job.picture import PictureLimits

__all__ = [
    "FileRef",
    "PictureLimits",
    "StageOrder",
    "StageResult",
    "merge_notes",
    "merge_reports",
]


@dataclass(frozen=True, slots=True)
class FileRef:
    """A file in the artifact store."""

    sha256: str
    bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class StageOrder:
    """One try of one stage of one job.

    spec    : the resolved spec, as spec.json holds it; figures: of `ResolvedJob`, as text
    inputs  : files of the job's earlier stages by name; the stage fetches those that it reads
    report  : parts of report.json made so far, merged; notes: likewise, sentences by part of the job
    scratch : path of a folder for this try only, which it makes and removes
    """

    job_id: str
    attempt: int
    stage: str
    spec: dict[str, Any]
    figures: str
    image_sha256: str
    image_name: str
    scratch: str
    limits: PictureLimits
    inputs: dict[str, FileRef] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    notes: dict[str, list[str]] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return asdict(self)

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> StageOrder:
        limits = data["limits"]
        return cls(
            **{
                **data,
                "inputs": _files(data["inputs"]),
                "limits": PictureLimits(max_pixels=limits["max_pixels"]),
            }
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class StageResult:
    """outputs: the files it made, by name; report, notes: this stage's own additions."""

    outputs: dict[str, FileRef]
    report: dict[str, Any]
    notes: dict[str, list[str]]
    seconds: float
    peak_rss_mb: float

    def plain(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return asdict(self)

    @classmethod
    def from_plain(cls, data: Mapping[str, Any]) -> StageResult:
        return cls(**{**data, "outputs": _files(data["outputs"])})


def merge_reports(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge report.json from the parts of its stages, in order: tables are joined, passes follow one another."""
    merged: dict[str, Any] = {}
    for part in parts:
        for key, value in part.items():
            if key == "passes":
                merged[key] = [*merged.get(key, ()), *value]
            elif key == "peak_rss_mb":
                merged[key] = max(merged.get(key, 0.0), value)
            elif isinstance(value, Mapping):
                merged[key] = {**merged.get(key, {}), **value}
            else:
                merged[key] = value
    return merged


def merge_notes(parts: Iterable[Mapping[str, Iterable[str]]]) -> dict[str, list[str]]:
    """Return the notes of all stages in their order, each sentence once."""
    merged: dict[str, list[str]] = {}
    for part in parts:
        for name, sentences in part.items():
            so_far = merged.setdefault(name, [])
            so_far += [sentence for sentence in dict.fromkeys(sentences) if sentence not in so_far]
    return merged


def _files(data: Mapping[str, Any]) -> dict[str, FileRef]:
    return {
        name: value if isinstance(value, FileRef) else FileRef(sha256=value["sha256"], bytes=value["bytes"])
        for name, value in data.items()
    }
