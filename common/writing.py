"""Writing files: an error names the file, and no part of it stays."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def writing(path: Path, *partial: Path) -> Iterator[None]:
    """Removes the files ``partial`` if the block fails, for example because the disk is full.

    An OSError that names no file, as those of `write`, then names ``path``.
    """
    try:
        yield
    except BaseException as error:
        for file in partial:
            with suppress(OSError):
                file.unlink()
        if isinstance(error, OSError) and error.filename is None:
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise
