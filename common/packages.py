"""Packages that may be missing, and the command that installs them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from common.errors import UserError

EXTRAS = {"torch": "paper", "pybullet": "physics"}  # extras of pyproject.toml
IN_CHECKOUT = (Path(__file__).resolve().parents[1] / "pyproject.toml").is_file()


def install_command(package: str) -> str:
    """The command that installs a missing package, by import name."""
    if IN_CHECKOUT:
        return "make install"
    return f"pip install 'presage[{EXTRAS[package]}]'" if package in EXTRAS else "pip install presage"


@contextmanager
def explain_missing_packages() -> Iterator[None]:
    """Turns a failed import of another project's package into a UserError that says how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "common", "services", "presage", "lab"):
            raise
        command = install_command(package)
        raise UserError(f"the package {package} is not installed; install it with: {command}") from None
