"""`get`: every byte, however often the wire breaks, and nothing that the server's list does not vouch for."""

from __future__ import annotations

import hashlib
from pathlib import Path

import httpx
import pytest

from tests.service.client.shop import BadWire, ShopWithoutWorker, run
from tests.waiting import PATIENCE_S


def list_files(shop: ShopWithoutWorker) -> dict[str, dict[str, object]]:
    answer = httpx.get(
        f"{shop.url}/v1/jobs/{shop.job()}/artifacts", trust_env=False, timeout=PATIENCE_S
    ).raise_for_status()
    return {item["name"]: item for item in answer.json()["artifacts"]}


def hashes(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


@pytest.mark.thorough
def test_all_files_come_and_come_once(shop: ShopWithoutWorker, tmp_path: Path) -> None:
    """The folder holds what the list names, but for what only the page draws; asked again, nothing is sent anew."""
    drawn = (".bin", ".path", "thumbnail.png")
    wanted = {name: item["sha256"] for name, item in list_files(shop).items() if not name.endswith(drawn)}
    first = run("get", shop.job(), "-o", str(tmp_path / "out"), server=shop.url)
    assert first.returncode == 0, first.stderr
    assert hashes(tmp_path / "out") == wanted
    again = run("get", shop.job(), "-o", str(tmp_path / "out"), server=shop.url)
    assert again.returncode == 0
    assert again.stdout.count("there already") == len(wanted)


@pytest.mark.thorough
def test_a_wire_that_breaks_every_few_kilobytes_costs_no_byte(shop: ShopWithoutWorker, tmp_path: Path) -> None:
    """Each connection is cut; the next goes on where the file ends, and the hash is right at last."""
    with BadWire(shop.url, lambda _, came: len(came) > 20_000) as wire:
        done = run("get", shop.job(), "-o", str(tmp_path / "out"), "--only", "heightfield.npz", server=wire.url)
    assert done.returncode == 0, done.stderr
    assert wire.cuts >= 2
    assert hashes(tmp_path / "out") == {"heightfield.npz": list_files(shop)["heightfield.npz"]["sha256"]}


def test_a_part_that_is_wrong_is_not_believed(shop: ShopWithoutWorker, tmp_path: Path) -> None:
    """A damaged beginning is found by the hash and fetched again; a part of another content is not touched."""
    item = list_files(shop)["target.png"]
    part = tmp_path / f"target.png.{str(item['sha256'])[:12]}.part"
    part.write_bytes(b"not the picture")
    other = tmp_path / "target.png.000000000000.part"
    other.write_bytes(b"of an earlier job")
    done = run("get", shop.job(), "-o", str(tmp_path), "--only", "target.png", server=shop.url)
    assert done.returncode == 0, done.stderr
    assert hashes(tmp_path)["target.png"] == item["sha256"]
    assert not part.exists()
    assert other.read_bytes() == b"of an earlier job"


def test_what_is_not_there_is_named(shop: ShopWithoutWorker, tmp_path: Path) -> None:
    done = run("get", shop.job(), "-o", str(tmp_path / "out"), "--only", "lens.obj", server=shop.url)
    assert done.returncode == 2
    assert "no file 'lens.obj'" in done.stderr and "lens.stl" in done.stderr
    assert not (tmp_path / "out").exists()
