"""`make install` and `make demo` install only what changed, as shown by --dry-run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.conftest import WAIT_TIMEOUT_S

ROOT = Path(__file__).resolve().parent.parent


def python(path, version):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\necho Python {version}\n")
    path.chmod(0o755)
    return path


@pytest.fixture
def install(tmp_path):
    """Shows what `make install` would do in a checkout that is installed with Python 3.11.9."""
    stamps = (".venv/.installed-demo", ".venv/.installed")
    for number, name in enumerate(("Makefile", "pyproject.toml", "constraints.txt", *stamps)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (number, number))
    shutil.copy(ROOT / "Makefile", tmp_path)
    python(tmp_path / ".venv/bin/python", "3.11.9")

    def run(*args, target="install"):
        command = ["make", "--dry-run", target, *args]
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=WAIT_TIMEOUT_S
        ).stdout

    return run


pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="no make here")


def test_nothing_changed(install, tmp_path):
    assert "pip install" not in install()
    same = python(tmp_path / "bin/python3.11", "3.11.9")
    assert "pip install" not in install(f"PYTHON={same}")


def test_another_python(install, tmp_path):
    other = python(tmp_path / "bin/python3.10", "3.10.14")
    assert f"names='{other}'" in install(f"PYTHON={other}")
    assert "pip install" in install("PYTHON=/nowhere/python")


def test_changed_requirements(install, tmp_path):
    os.utime(tmp_path / "pyproject.toml")
    assert "pip install" in install()


def test_demo_and_development_are_installed_separately(install, tmp_path):
    (tmp_path / ".venv/.installed").unlink()
    assert "pip install" not in install(target="demo")
    assert "-e '.[dev]'" in install()
    (tmp_path / ".venv/.installed-demo").unlink()
    assert "-e '.'" in install(target="demo")


def test_seeds_of_tables():
    """`make tables` repeats the commands of the pages with their seeds."""
    recipe = (ROOT / "Makefile").read_text().partition("\ntables:")[2].partition("\n\n")[0]
    pages = "".join(page.read_text() for page in [ROOT / "README.md", *ROOT.glob("docs/*.md")])
    seeds = set(re.findall(r"--seed \d+", recipe))
    assert seeds
    assert {seed for seed in seeds if seed not in pages} == set()
