"""Writable folders and free disk space."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil

from presage.diagnosis.findings import Finding

MIN_FREE_BYTES = 500e6
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - only tested for being writable


def check_machine(recordings: Path) -> Iterator[Finding]:
    """Checks that the folder of recordings is writable and its disk not nearly full, and that caches are writable."""
    folder = _nearest_existing(recordings)
    if problem := find_write_error(folder):
        advice = "choose another folder with --directory of the recorder, or change the permissions of this one"
        yield Finding(
            "not_writable", False, f"recordings cannot be written to {folder}: {problem}", str(folder), advice
        )
    else:
        yield Finding("not_writable", True, f"recordings: {folder} is writable", str(folder))
    free = shutil.disk_usage(folder).free
    full = free < MIN_FREE_BYTES
    advice = "remove old recordings, or record elsewhere: a recorder that cannot write ends" if full else ""
    yield Finding("disk", not full, f"disk of {folder}: {free / 1e6:.0f} MB free", str(folder), advice)
    yield from _check_caches()


def _check_caches() -> Iterator[Finding]:
    services = Path(__file__).parents[2] / "services"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    for cache in [Path(chosen)] if chosen else [services / "estimator", services / "controller"]:
        if problem := find_write_error(_nearest_existing(cache)):
            what = f"compiled code cannot be cached in {cache}: {problem}"
            advice = "services compile their code again at each start; set NUMBA_CACHE_DIR to a writable folder"
            yield Finding("not_writable", None, what, str(cache), advice)
            break  # the advice is the same for the other
    if SHARED_MEMORY.is_dir() and (problem := find_write_error(SHARED_MEMORY)):
        advice = "experiments on several cores fail; the services do not need it"
        yield Finding("not_writable", None, f"{SHARED_MEMORY} cannot be used: {problem}", str(SHARED_MEMORY), advice)


def find_stopped_processes(service: str) -> Iterator[Finding]:
    """Finds processes of the service on this machine that are stopped (SIGSTOP).

    A session opened after the stop does not receive their liveliness tokens, so that they look missing on the bus.
    """
    for process in psutil.process_iter(["cmdline", "status"]):
        arguments = process.info["cmdline"] or []
        if f"services.{service}" in arguments and process.info["status"] == psutil.STATUS_STOPPED:
            what = f"{service}: process {process.pid} of this machine is stopped"
            yield Finding("frozen", False, what, f"process {process.pid}", f"kill -CONT {process.pid} resumes it")


def find_write_error(folder: Path) -> str:
    """Returns the error when a file is created in an existing folder, or ""; leaves no file behind."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _nearest_existing(folder: Path) -> Path:
    """The folder, or its nearest parent that exists."""
    folder = folder.absolute()
    return next((each for each in (folder, *folder.parents) if each.is_dir()), Path("/"))
