"""Installed packages and trained models."""

from __future__ import annotations

import importlib.util
import platform
import sys
from collections.abc import Iterator

from common.errors import UserError
from common.geometry.world import known_worlds, load_world
from common.packages import install_command
from presage.diagnosis.findings import Finding

PACKAGES_OF_SERVICES = {
    "simulator": ("scipy",),
    "estimator": ("safetensors", "numba", "scipy"),
    "mapper": ("numba", "scipy", "PIL"),
    "controller": ("scipy",),
    "recorder": ("mcap", "zstandard", "lz4"),
}


def check_installation(world: str) -> Iterator[Finding]:
    """Checks Python, the packages of each service, and the weights for ``world``; lists those of other worlds."""
    python = platform.python_version()
    supported = sys.version_info >= (3, 10)
    advice = "" if supported else "3.10 or later is needed; `make install` chooses one"
    yield Finding("python", supported, f"Python {python}", sys.executable, advice)
    for service, packages in PACKAGES_OF_SERVICES.items():
        missing = [name for name in packages if importlib.util.find_spec(name) is None]
        what = f"{service}: {'missing packages ' + ', '.join(missing) if missing else 'installed'}"
        yield Finding("packages", not missing, what, service, install_command(missing[0]) if missing else "")
    if importlib.util.find_spec("pybullet") is None:
        what = "simulator: kinematic, without pybullet, which has wheels for Python 3.10 and 3.11 on Linux x86_64"
        yield Finding("packages", None, what, "simulator", install_command("pybullet"))
    if importlib.util.find_spec("torch") is None:
        yield Finding("packages", None, "preset paper needs torch", "estimator", install_command("torch"))
    if all(importlib.util.find_spec(name) for name in PACKAGES_OF_SERVICES["estimator"]):
        yield from _check_weights(world)
    else:
        yield Finding("weights", None, "weights: not checked, because the estimator is not installed here")


def _check_weights(used_world: str) -> Iterator[Finding]:
    from services.estimator.precise.learning import weights as precise  # needs the estimator's packages
    from services.estimator.shared.model_folder import SHIPPED, find_folder

    try:
        world = load_world(used_world)
        precise.find(find_folder(world.name, precise.PRESET), world, used_world)
    except UserError as error:
        yield Finding("weights", False, str(error), str(SHIPPED))  # the message says what to do
    for name in known_worlds():
        folder = find_folder(name, precise.PRESET)
        learned = precise.path_of(folder, name).exists()
        others = sorted(path.stem for path in folder.glob(f"{name}-*.safetensors"))
        text = ", ".join(others) or "none"
        advice = "" if learned else precise.train_command(name)
        yield Finding("weights", True if learned else None, f"weights for {name}: {text}", str(folder), advice)
