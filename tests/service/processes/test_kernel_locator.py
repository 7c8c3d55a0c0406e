"""A compiled kernel is known by the code that it is made of: all of it, and nothing else."""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

from service.processes import kernel_locator
from service.processes.kernel_locator import _definition, _names, kernel_hash

_FILES = {
    "pack/upper.py": '''"""Upper."""
from math import sqrt

from numba import njit

from pack import plain
from pack.lower import SIZE, helper

UNUSED = 1


@njit(cache=True)
def kernel(x):
    """Kernel."""
    return helper(x) + sqrt(SIZE) + plain.offset(x)


def caller(x):
    return kernel(x)
''',
    "pack/lower.py": '''"""Lower."""
from numba import njit

SIZE = 3


@njit(cache=True)
def helper(x):
    """Helper."""
    return _deep(x)


@njit(cache=True)
def _deep(x):
    return x + 1
''',
    "pack/plain.py": "def offset(x):\n    return x\n",
}


@pytest.fixture
def hash_after(tmp_path):
    def after(name: str = "", old: str = "", new: str = "") -> str:
        for path, text in _FILES.items():
            file = tmp_path / path
            file.parent.mkdir(exist_ok=True)
            file.write_text(text.replace(old, new) if path == name else text)
        _definition.cache_clear()
        _names.cache_clear()
        return kernel_hash("pack.upper", "kernel", tmp_path)

    return after


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("pack/upper.py", "+ sqrt", "- sqrt"),
        ("pack/upper.py", "from math", "from numpy"),
        ("pack/upper.py", "njit(cache=True)", "njit(cache=True, fastmath=True)"),
        ("pack/lower.py", "SIZE = 3", "SIZE = 4"),
        ("pack/lower.py", "x + 1", "x + 2"),
        ("pack/plain.py", "return x", "return -x"),
    ],
)
def test_a_change_in_anything_that_it_uses_is_another_kernel(hash_after, name, old, new):
    assert hash_after(name, old, new) != hash_after()


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("pack/upper.py", "Kernel.", "The kernel."),
        ("pack/lower.py", '    """Helper."""\n', "    # a helper\n"),
        ("pack/upper.py", "UNUSED = 1", "UNUSED = 2"),
        ("pack/upper.py", "return kernel(x)", "return 2 * kernel(x)"),
        ("pack/upper.py", "import SIZE, helper", "import SIZE, _deep, helper"),
    ],
)
def test_words_and_code_beside_it_are_not(hash_after, name, old, new):
    assert hash_after(name, old, new) == hash_after()


@pytest.mark.thorough
def test_what_a_process_has_found_the_next_knows_while_the_sources_are_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_locator.numba_config, "CACHE_DIR", str(tmp_path))
    ends = []
    monkeypatch.setattr(kernel_locator.atexit, "register", lambda *end: ends.append(partial(*end)))
    source = tmp_path / "optics" / "lower.py"
    source.parent.mkdir()

    def known_to_a_process() -> dict[str, str]:
        for one in (kernel_locator._load_known_hashes, _definition, _names):
            one.cache_clear()
        known = dict(kernel_locator._load_known_hashes(tmp_path))
        assert kernel_locator._find_hash("optics.lower", "kernel", tmp_path)
        ends.pop()()
        return known

    source.write_text("def kernel(x): return x\n")
    assert known_to_a_process() == {}
    assert known_to_a_process() == {"optics.lower.kernel": kernel_hash("optics.lower", "kernel", tmp_path)}
    source.write_text("def kernel(x): return -x\n")
    assert known_to_a_process() == {}


@pytest.mark.thorough
def test_numba_keeps_a_kernel_under_that_name(tmp_path):
    code = (
        "import numpy as np\nfrom service.processes.kernel_cache import use_current_kernels\nuse_current_kernels()\n"
        "from optics.transport.anderson import _remember\n"
        "a = np.zeros(2)\n_remember(0, 1, a, a, np.zeros((1, 2)), 0, True)\nprint(_remember.stats.cache_hits)\n"
    )
    environment = {"NUMBA_CACHE_DIR": str(tmp_path), "PATH": ""}

    def hits() -> int:
        told = subprocess.check_output([sys.executable, "-c", code], env=environment)
        return told.split(b"{")[-1].count(b": 1")

    with ThreadPoolExecutor(3) as several:  # at once: one compiles, the others wait for it
        assert sorted(one.result() for one in [several.submit(hits) for _ in range(3)]) == [0, 1, 1]
    assert hits() == 1
    hashes, folder = sorted(tmp_path.iterdir())
    kept = json.loads(hashes.read_text())
    assert kept == {name: kernel_hash(*name.rsplit(".", 1)) for name in kept} != {}
    assert folder.name == f"optics.transport.anderson._remember-{kernel_hash('optics.transport.anderson', '_remember')}"
    # A type of an argument that stands elsewhere now: compiled anew, and found again afterwards.
    (index,) = folder.glob("*.nbi")
    with index.open("rb") as file:
        version = pickle.load(file)
    index.write_bytes(pickle.dumps(version) + b"cno.such.module\nRule\n.")
    assert [hits(), hits()] == [0, 1]
