"""Writable folders and free disk space."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil

from presage.diagnosis.findings import Finding

LEAST_FREE = 500e6  # bytes; a disk fuller than that is nearly full
MEMORY_FILES = Path("/dev/shm")  # noqa: S108 - looked at, not used


def look_at_machine(recordings: Path) -> Iterator[Finding]:
    """The folder of recordings must be writable and have room; caches should be."""
    folder = _existing(recordings)
    if why := why_not_writable(folder):
        advice = "choose another folder with --directory of the recorder, or make this one yours"
        yield Finding("not_writable", False, f"recordings cannot be written to {folder}: {why}", str(folder), advice)
    else:
        yield Finding("not_writable", True, f"recordings: {folder} can be written to", str(folder))
    free = shutil.disk_usage(folder).free
    full = free < LEAST_FREE
    advice = "remove old recordings, or record elsewhere: a recorder that cannot write ends" if full else ""
    yield Finding("disk", not full, f"disk of {folder}: {free / 1e6:.0f} MB free", str(folder), advice)
    yield from _caches()


def _caches() -> Iterator[Finding]:
    cache = Path(os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parents[2] / "services" / "estimator")
    if why := why_not_writable(_existing(cache)):
        advice = "the estimator compiles its loops anew at each start; NUMBA_CACHE_DIR names another folder"
        yield Finding("not_writable", None, f"compiled code cannot be kept in {cache}: {why}", str(cache), advice)
    if MEMORY_FILES.is_dir() and (why := why_not_writable(MEMORY_FILES)):
        advice = "experiments on several cores fail; the services do not use it"
        yield Finding("not_writable", None, f"{MEMORY_FILES} cannot be used: {why}", str(MEMORY_FILES), advice)


def look_for_stopped(service: str) -> Iterator[Finding]:
    """Processes of the service on this machine that are stopped: who comes to a session later does not hear of them."""
    for process in psutil.process_iter(["cmdline", "status"]):
        words = process.info["cmdline"] or []
        if f"services.{service}" in words and process.info["status"] == psutil.STATUS_STOPPED:
            what = f"{service}: process {process.pid} of this machine is stopped"
            yield Finding("frozen", False, what, f"process {process.pid}", f"kill -CONT {process.pid} lets it go on")


def why_not_writable(folder: Path) -> str:
    """Why no file can be made in an existing folder; empty: one can. Leaves no trace."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _existing(folder: Path) -> Path:
    """The folder, or the nearest above it that is there."""
    folder = folder.absolute()
    return next((each for each in (folder, *folder.parents) if each.is_dir()), Path("/"))
