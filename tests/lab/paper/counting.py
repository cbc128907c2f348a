"""A trial for tests of workers, which import this module: it needs nothing of the project, so they start quickly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Count:
    index: int
    folder: str
    fails_at: int = -1
    world: str = ""


def count(job):
    """A trial that records its execution in a file, and may fail."""
    if job.index == job.fails_at and not (Path(job.folder) / "mended").exists():
        raise ValueError("as asked")
    with (Path(job.folder) / "ran").open("a") as file:
        file.write(f"{job.index}\n")
    return {"square": job.index**2}
