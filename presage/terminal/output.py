"""Checks output paths, writes JSON, and makes text from the bus printable."""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from common.errors import UserError
from common.versions import commit, versions
from common.writing import name_in_errors


def check_file(file: Path | None, option: str) -> None:
    """Raises UserError if ``file`` cannot be written; a file that the check creates is deleted again."""
    if file is None or (file.exists() and not file.is_file() and not file.is_dir()):
        return  # do not open a pipe or device for a check: closing it would end its reader
    existed = file.exists()
    try:
        with file.open("ab"):
            pass
    except OSError as error:
        raise UserError(f"{file}: cannot be written to ({error.strerror}); choose another file with {option}") from None
    if not existed:
        file.unlink()


def make_folder(folder: Path, option: str = "--out") -> None:
    """Creates ``folder`` with its parents. Raises UserError if it cannot be created or written into.

    ``option`` chooses another folder.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise UserError(
            f"{folder}: cannot be written to ({error.strerror}); choose another folder with {option}"
        ) from None


@contextmanager
def output_folder(folder: Path, option: str = "--out") -> Iterator[None]:
    """`make_folder` for the block; removes new folders if the block, perhaps interrupted, leaves them empty."""
    new = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder, option)
    try:
        yield
    finally:
        for each in new:
            with suppress(OSError):  # it is not empty
                each.rmdir()


def write_json(file: Path | None, data: dict[str, Any]) -> None:
    """Writes ``data`` as indented JSON; does nothing if ``file`` is None."""
    if file is not None:
        with name_in_errors(file):
            file.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def provenance(seed: int | None = None) -> dict[str, Any]:
    """The information needed to reproduce a result: seed if there is one, commit, versions, command-line arguments."""
    found = {"commit": commit(), "versions": versions(), "arguments": sys.argv[1:]}
    return found if seed is None else {"seed": seed, **found}


def machine() -> str:
    """Architecture and number of cores of this machine, for results that depend on it."""
    return f"{platform.machine()}, {os.cpu_count()} cores"


def printable(text: str) -> str:
    """Text received on the bus with "?" for control characters, which could change the state of the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)
