"""Writing files: they appear only when they are complete, and an error names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


@contextmanager
def complete_files(path: Path) -> Iterator[Path]:
    """Yields a new folder, whose files are moved into that of ``path`` at the end.

    If the block fails, for example because the disk is full, they are removed, and existing files stay. An OSError of
    writing then names ``path``.
    """
    with naming(path), TemporaryDirectory(dir=path.parent, prefix=f".{path.name}-") as partial:
        yield Path(partial)
        for file in sorted(Path(partial).iterdir()):
            file.replace(path.parent / file.name)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Lets an OSError name ``path`` if it names no file, as those of `write`, or a file of `complete_files`."""
    try:
        yield
    except OSError as error:
        names = f".{path.name}-"
        if error.filename is None or any(part.startswith(names) for part in Path(str(error.filename)).parts):
            raise OSError(error.errno, error.strerror or str(error), str(path)) from error
        raise
