"""Puts the other files of a release beside its wheel:  python -m docs.release FOLDER SITE

The changelog, the documents as a site, the software bill of materials of the lock (CycloneDX 1.6), and the hashes of
all files in the folder.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

TOP = Path(__file__).parents[1]
LOCK = TOP / "requirements.lock"
_PINNED = re.compile(r"^([\w.-]+)(?:\[[\w,-]+\])?==(\S+)(?: ; (.+?))?(?: \\)?$")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")
_BEGIN = (1980, 1, 1, 0, 0, 0)  # the earliest time that an archive can state


def main(folder: Path, site: Path) -> None:
    shutil.copy(TOP / "CHANGELOG.md", folder)
    bill = json.dumps(bill_of_materials(LOCK.read_text("utf-8")), indent=1)
    (folder / "sbom.cdx.json").write_text(bill + "\n", encoding="utf-8")
    with zipfile.ZipFile(folder / "docs.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(path for path in site.rglob("*") if path.is_file()):
            name = path.relative_to(site).as_posix()
            archive.writestr(zipfile.ZipInfo(name, _BEGIN), path.read_bytes(), zipfile.ZIP_DEFLATED)
    files = sorted(path for path in folder.iterdir() if path.name != "SHA256SUMS")
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in files]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


def bill_of_materials(lock: str) -> dict[str, Any]:
    """Return the packages of a lock: versions, restrictions to platforms, and the hashes of the files that may be
    installed.
    """
    return {"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "components": list(_components(lock))}


def _components(lock: str) -> Iterator[dict[str, Any]]:
    found: dict[str, Any] = {}
    for line in lock.splitlines():
        if package := _PINNED.match(line):
            if found:
                yield found
            name, version, marker = package.groups()
            where = [{"name": "environment", "value": marker}] if marker else []
            found = {"type": "library", "name": name, "version": version, "purl": f"pkg:pypi/{name}@{version}"}
            found |= {"properties": where, "externalReferences": []}
        elif digest := _HASH.search(line):
            file = {"type": "distribution", "url": found["purl"]}
            found["externalReferences"].append(file | {"hashes": [{"alg": "SHA-256", "content": digest[1]}]})
    if found:
        yield found


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
