"""Folders of trained models: the shipped ones, and those that the user trained."""

from __future__ import annotations

import os
from pathlib import Path

from common.packages import IN_CHECKOUT

SHIPPED = Path(__file__).resolve().parents[3] / "models"


def training_folder() -> Path:
    """The folder into which `presage train` writes: `models` of a checkout, else one below XDG_DATA_HOME."""
    if IN_CHECKOUT:
        return SHIPPED
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "presage" / "models"


def find_folder(world: str, preset: str) -> Path:
    """The folder with the models of a world: the user's if it has any for this world, else the shipped one."""
    trained = training_folder()
    return trained if any(trained.glob(f"{world}-{preset}*.safetensors")) else SHIPPED
