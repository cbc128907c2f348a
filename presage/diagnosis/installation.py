"""Installed packages and trained models."""

from __future__ import annotations

import importlib.util
import platform
import sys
from collections.abc import Iterator

from common.errors import UserError
from common.geometry.world import known_worlds, load_world
from presage.diagnosis.findings import Finding

NEEDED = {
    "simulator": ("pybullet",),
    "estimator": ("torch", "safetensors", "numba"),
    "controller": ("scipy",),
    "recorder": ("mcap", "zstandard", "lz4"),
}


def look_at_installation(world: str) -> Iterator[Finding]:
    """Python, packages, and the weights for ``world``; what other worlds have is worth knowing."""
    python = platform.python_version()
    fits = sys.version_info >= (3, 10)
    advice = "" if fits else "3.10 or 3.11 is needed; `make install` picks one"
    yield Finding("python", fits, f"Python {python}", sys.executable, advice)
    for service, packages in NEEDED.items():
        missing = [name for name in packages if importlib.util.find_spec(name) is None]
        what = f"{service}: {'misses ' + ', '.join(missing) if missing else 'installed'}"
        yield Finding("packages", not missing, what, service, f"pip install 'presage[{service}]'" if missing else "")
    if all(importlib.util.find_spec(name) for name in NEEDED["estimator"]):
        yield from _weights(world)
    else:
        yield Finding("weights", None, "weights: not looked at, the estimator is not installed here")


def _weights(asked: str) -> Iterator[Finding]:
    from services.estimator.precise.learning import weights as precise  # noqa: PLC0415 - only where its packages are

    where = str(precise.FOLDER)
    try:
        precise.find(precise.FOLDER, load_world(asked), asked)
    except UserError as error:
        what, _, advice = str(error).partition("; ")
        yield Finding("weights", False, what, where, advice or precise.train_command(asked))
    for world in known_worlds():
        learned = precise.path_of(precise.FOLDER, world).exists()
        there = sorted(path.stem for path in precise.FOLDER.glob(f"{world}-*.safetensors"))
        text = ", ".join(there) or "none"
        advice = "" if learned else precise.train_command(world)
        yield Finding("weights", True if learned else None, f"weights for {world}: {text}", where, advice)
