"""Installed packages and trained models."""

from __future__ import annotations

import importlib.util
import platform
import sys
from collections.abc import Iterator

from common.errors import UserError
from common.geometry.world import known_worlds, load_world
from presage.diagnosis.findings import Finding

PACKAGES_OF_SERVICES = {
    "simulator": ("pybullet",),
    "estimator": ("torch", "safetensors", "numba"),
    "controller": ("scipy",),
    "recorder": ("mcap", "zstandard", "lz4"),
}


def check_installation(world: str) -> Iterator[Finding]:
    """Checks Python, the packages of each service, and the weights for ``world``; lists those of other worlds."""
    python = platform.python_version()
    supported = sys.version_info >= (3, 10)
    advice = "" if supported else "3.10 or 3.11 is needed; `make install` chooses one"
    yield Finding("python", supported, f"Python {python}", sys.executable, advice)
    for service, packages in PACKAGES_OF_SERVICES.items():
        missing = [name for name in packages if importlib.util.find_spec(name) is None]
        what = f"{service}: {'missing packages ' + ', '.join(missing) if missing else 'installed'}"
        yield Finding("packages", not missing, what, service, f"pip install 'presage[{service}]'" if missing else "")
    if all(importlib.util.find_spec(name) for name in PACKAGES_OF_SERVICES["estimator"]):
        yield from _check_weights(world)
    else:
        yield Finding("weights", None, "weights: not checked, because the estimator is not installed here")


def _check_weights(used_world: str) -> Iterator[Finding]:
    from services.estimator.precise.learning import weights as precise  # needs the estimator's packages

    where = str(precise.FOLDER)
    try:
        precise.find(precise.FOLDER, load_world(used_world), used_world)
    except UserError as error:
        yield Finding("weights", False, str(error), where)  # the message says what to do
    for world in known_worlds():
        learned = precise.path_of(precise.FOLDER, world).exists()
        others = sorted(path.stem for path in precise.FOLDER.glob(f"{world}-*.safetensors"))
        text = ", ".join(others) or "none"
        advice = "" if learned else precise.train_command(world)
        yield Finding("weights", True if learned else None, f"weights for {world}: {text}", where, advice)
