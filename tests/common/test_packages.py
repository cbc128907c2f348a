"""Commands that need a package which is not installed name the command that installs it."""

from __future__ import annotations

import subprocess
import sys

import pytest

from common import packages
from common.errors import UserError

WITHOUT_TORCH = "import sys; sys.modules['torch'] = None; from presage.__main__ import main; main()"


@pytest.mark.parametrize(
    "arguments",
    ["up --estimator paper", "train --preset paper", "bench decoders"],
)
def test_commands_without_torch(arguments, tmp_path):
    command = [sys.executable, "-c", WITHOUT_TORCH, *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "presage: the package torch is not installed; install it with: make install\n"


@pytest.mark.parametrize(("package", "command"), [("torch", "'presage[paper]'"), ("yaml", "pip install presage")])
def test_command_outside_a_checkout(monkeypatch, package, command):
    monkeypatch.setattr(packages, "IN_CHECKOUT", False)
    with pytest.raises(UserError, match="install it with: pip install ") as error, packages.explain_missing_packages():
        raise ModuleNotFoundError(name=f"{package}.nn")
    assert str(error.value).endswith(command)


def test_own_modules_are_not_explained():
    with pytest.raises(ModuleNotFoundError), packages.explain_missing_packages():
        raise ModuleNotFoundError(name="services.estimator.missing")
