"""Test pieces that a server keeps: one of each machine, made when it is first asked for."""

from __future__ import annotations

import hashlib
import io
import shutil
import zipfile
from dataclasses import asdict
from pathlib import Path

from service.job import files as job_files
from service.job.coupon.piece import coupon_job, coupon_of
from service.job.coupon.programs import make_coupon
from service.progress import report_progress

_NOT_SENT = {job_files.COUPON_ARCHIVE, job_files.HEIGHTFIELD}


def keep_coupon(folder: Path, machine: str) -> Path:
    """Return the machine's test piece in a folder of test pieces, with an archive of it; make it if there is none.

    A newer version of us keeps it: it may have been milled. One made for what the profile said before makes way.
    SpecError where there is no such machine.
    """
    job = coupon_job(machine=machine, throw_mm=None, file=None, overrides=())
    facts = repr((job.spec.plain(), asdict(job.machine), coupon_of(job)))
    piece = folder / machine / hashlib.sha256(facts.encode()).hexdigest()[:16]
    if not (piece / job_files.COUPON_ARCHIVE).is_file():
        piece.parent.mkdir(parents=True, exist_ok=True)
        with report_progress(quiet=True) as reporter:
            make_coupon(piece, job, reporter=reporter)
        job_files.write_bytes(piece / job_files.COUPON_ARCHIVE, _pack(piece))
        for older in piece.parent.glob("[!.]*"):  # a hidden one is being made
            if older != piece:
                shutil.rmtree(older, ignore_errors=True)
    return piece


def _pack(piece: Path) -> bytes:
    """Pack all that is needed to mill the piece, and to measure its photograph elsewhere."""
    held = io.BytesIO()
    with zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(piece.iterdir()):
            if path.name not in _NOT_SENT:
                archive.writestr(job_files.zip_entry(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return held.getvalue()
