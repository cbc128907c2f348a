"""Where trained models are: the shipped ones, and those that the user trained."""

from __future__ import annotations

import os
from pathlib import Path

from common.packages import IN_CHECKOUT

SHIPPED = Path(__file__).resolve().parents[3] / "models"


def training_folder() -> Path:
    """Where `presage train` writes: `models` of a checkout, otherwise ~/.local/share/presage/models (XDG_DATA_HOME)."""
    if IN_CHECKOUT:
        return SHIPPED
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "presage" / "models"


def find_folder(world: str, preset: str) -> Path:
    """The folder with the models of a world: what the user trained comes before what is shipped."""
    own = training_folder()
    return own if any(own.glob(f"{world}-{preset}*.safetensors")) else SHIPPED
