"""Disks that are full or slow, under one folder only.

A small disk is a file system of its own in memory (mount, so only as root). A slow disk is a library that is loaded
before the C library (LD_PRELOAD) and delays fsync and fdatasync of files below the folder while a switch is on: what a
failing disk, a busy network share or a laptop that wakes up does, without stopping any process from outside.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

_SOURCE = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

/* SLOW_DISK_SWITCH: a file; while it is there nothing below SLOW_DISK_FOLDER gets safe. Its text: seconds each, else
   until it is gone. */
static void wait_for_disk(int file) {
    const char *folder = getenv("SLOW_DISK_FOLDER"), *power = getenv("SLOW_DISK_SWITCH");
    char name[64], path[4096], text[32];
    if (!folder || !power || access(power, F_OK) != 0) return;
    snprintf(name, sizeof name, "/proc/self/fd/%d", file);
    ssize_t length = readlink(name, path, sizeof path - 1);
    if (length < 0) return;
    path[length] = 0;
    if (strncmp(path, folder, strlen(folder)) != 0) return;
    double left_s = 1e9;
    FILE *given = fopen(power, "r");
    if (given) {
        if (fgets(text, sizeof text, given) && atof(text) > 0) left_s = atof(text);
        fclose(given);
    }
    struct timespec pause = {0, 10000000};
    for (; left_s > 0 && access(power, F_OK) == 0; left_s -= 0.01) nanosleep(&pause, 0);
}

int fsync(int file) {
    static int (*real)(int);
    if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
    wait_for_disk(file);
    return real(file);
}

int fdatasync(int file) {
    static int (*real)(int);
    if (!real) real = (int (*)(int))dlsym(RTLD_NEXT, "fdatasync");
    wait_for_disk(file);
    return real(file);
}
"""


class SlowDisk:
    """Give `environment` to the processes whose files below the folder are meant."""

    def __init__(self, library: Path, folder: Path, switch: Path) -> None:
        self._switch = switch
        self.environment = {
            "LD_PRELOAD": str(library),
            "SLOW_DISK_FOLDER": f"{folder.resolve()}/",
            "SLOW_DISK_SWITCH": str(switch.resolve()),
        }

    @contextlib.contextmanager
    def slow(self, each_s: float) -> Iterator[None]:
        """Every sync takes so much longer."""
        self._switch.write_text(str(each_s))
        try:
            yield
        finally:
            self._switch.unlink()

    @contextlib.contextmanager
    def stalled(self) -> Iterator[None]:
        """No sync ends before the block does."""
        self._switch.touch()
        try:
            yield
        finally:
            self._switch.unlink()


def missing_for_slow() -> str:
    """Why no disk can be slowed here, in one line; "" where it can."""
    return "" if shutil.which("gcc") and os.uname().sysname == "Linux" else "no gcc here to make a slow disk with"


def slow_disk(work: Path, folder: Path) -> SlowDisk:
    """A disk under `folder` that can be slowed; what it needs is made in `work`."""
    source, library = work / "slow_disk.c", work / "slow_disk.so"
    source.write_text(_SOURCE)
    subprocess.run(["gcc", "-O1", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return SlowDisk(library, folder, work / "slow")


class SmallDisk:
    """A file system of its own at `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._filler = folder / ".filler"

    @contextlib.contextmanager
    def full(self) -> Iterator[None]:
        """Not a byte is free while the block runs."""
        with self._filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while file.write(b"x" * 4096):
                continue
        try:
            yield
        finally:
            self._filler.unlink()


def missing_for_small() -> str:
    """Why no file system can be mounted here, in one line; "" where it can."""
    if os.geteuid() != 0 or not shutil.which("mount"):
        return "only root can mount a small disk"
    try:
        with tempfile.TemporaryDirectory() as folder, small_disk(Path(folder) / "disk", mb=1):
            return ""
    except subprocess.CalledProcessError:
        return "no file system may be mounted here"


@contextlib.contextmanager
def small_disk(folder: Path, *, mb: int) -> Iterator[SmallDisk]:
    folder.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={mb}m,mode=700", "tmpfs", folder], check=True, stderr=subprocess.DEVNULL
    )
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)
