"""Writing files: they appear only when they are complete, and an error names the file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

PARTIAL = ".presage-"  # how the name of a folder with incomplete files begins


@contextmanager
def complete_files(name: Path, folder: Path | None = None) -> Iterator[Path]:
    """Yields a new folder, whose files are moved into ``folder`` at the end, by default into that of ``name``.

    If the block fails, for example because the disk is full, they are removed, and existing files stay. An OSError of
    writing then names ``name``. The files are moved one after another, so an error meanwhile may leave some old.
    """
    target = name.parent if folder is None else folder
    with name_in_errors(name), TemporaryDirectory(dir=target, prefix=PARTIAL) as partial:
        yield Path(partial)
        for file in sorted(Path(partial).iterdir()):
            file.replace((target / file.name).resolve())  # of a symbolic link, the file to which it leads


@contextmanager
def name_in_errors(name: Path) -> Iterator[None]:
    """Lets an OSError name ``name`` if it names no file, as those of `write`, or a file of `complete_files`."""
    try:
        yield
    except OSError as error:
        is_partial = any(part.startswith(PARTIAL) for part in Path(str(error.filename)).parts)
        if error.errno is None or (error.filename is not None and not is_partial):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(name)) from error
