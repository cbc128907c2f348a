"""Folders of trained models: the shipped ones, and those that the user trained; writing a model."""

from __future__ import annotations

import os
from pathlib import Path

from common.packages import IN_CHECKOUT
from common.writing import complete_files

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


def write_weights_and_card(path: Path, weights: bytes, card: str) -> None:
    """Writes ``weights`` to ``path`` and the card beside it; replaces existing files when both are complete."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with complete_files(path) as folder:
        (folder / path.name).write_bytes(weights)
        (folder / path.with_suffix(".json").name).write_text(card, encoding="utf-8")
