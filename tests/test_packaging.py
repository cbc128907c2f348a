"""The requirements in pyproject.toml, and the built wheel outside a checkout."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from common.geometry import se2
from common.geometry.world import load_world
from common.robot.scanner import SCANNERS

ROOT = Path(__file__).resolve().parent.parent
tomllib = pytest.importorskip("tomllib", reason="Python 3.10 cannot read pyproject.toml")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = PYPROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]


def names(requirements):
    return {canonicalize_name(Requirement(each).name) for each in requirements} - {"presage"}


REQUIRED = names(sum(PYPROJECT["project"]["optional-dependencies"].values(), PYPROJECT["project"]["dependencies"]))


def test_every_requirement_is_pinned():
    pinned = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    assert {canonicalize_name(name) for name in pinned} >= REQUIRED


def test_images_have_known_packages():
    for group in PYPROJECT["dependency-groups"].values():
        assert names(each for each in group if isinstance(each, str)) <= REQUIRED


def use_compiled_code(site):
    """Saves compiling all loops again: numba takes the checkout's for sources of the same modification time."""
    caches = {file.parent for package in PACKAGES for file in (ROOT / package).rglob("__pycache__/*.nbi")}
    for cache in caches:
        to = site / cache.relative_to(ROOT)
        to.mkdir(exist_ok=True)
        for compiled in cache.glob("*.nb[ic]"):
            shutil.copy(compiled, to)
        for source in cache.parent.glob("*.py"):
            shutil.copystat(source, to.parent / source.name)


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Runs Python outside the checkout with the wheel installed; the environment's packages are visible."""
    pytest.importorskip("hatchling")
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(ROOT)]
    subprocess.run(build, check=True)
    (wheel,) = folder.glob("presage-*.whl")
    install = [*pip, "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder / "site"), str(wheel)]
    subprocess.run(install, check=True)
    use_compiled_code(folder / "site")

    def run(*arguments):
        variables = {"PYTHONPATH": str(folder / "site"), "XDG_DATA_HOME": str(folder / "data")}
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env={**os.environ, **variables})
        assert done.returncode == 0, done.stderr
        return done.stdout

    run.folder = folder
    return run


def test_wheel_has_the_command_line(installed):
    assert "Usage: presage" in installed(installed.folder / "site" / "bin" / "presage", "--help")


def test_wheel_localises(installed):
    scanner, poses = SCANNERS["tim571"].with_beams(200), np.tile([4.0, 1.5, 1.0], (5, 1))
    lasers = se2.compose(poses, np.array(scanner.mount))
    ranges = load_world("corridor").ray_distances(lasers, scanner.angles())
    np.savez(installed.folder / "scans.npz", ranges=ranges, angles=scanner.angles(), range_max=25.0)
    installed("-m", "presage", "localize", "scans.npz", "--world", "corridor", "--out", "poses.csv")
    assert len((installed.folder / "poses.csv").read_text().splitlines()) > 5


def test_installed_models_are_trained_elsewhere(installed):
    folder = "import services.estimator.shared.model_folder as m; print(m.training_folder())"
    assert Path(installed("-c", folder).strip()) == installed.folder / "data" / "presage" / "models"
