"""Saves and resumes an interrupted training."""

from __future__ import annotations

import json
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch

from common.errors import UserError
from common.writing import complete_files
from services.estimator.paper.training import Trainer, TrainingData

DAMAGED_FILE_ERRORS = (zipfile.BadZipFile, zlib.error, safetensors.SafetensorError)


class Checkpoint:
    """A folder with the state of an unfinished training, which a training with the same ``recipe`` can resume."""

    def __init__(self, folder: Path, recipe: dict[str, Any]) -> None:
        """Opens the folder, and empties it if it is that of another recipe.

        ``discarded`` is then true if that training had stored samples or weights.
        """
        self.folder, self.recipe = folder, json.loads(json.dumps(recipe))
        self.discarded = False
        if folder.exists() and self._read("recipe.json") != self.recipe:
            self.discarded = any(path.suffix in {".npz", ".safetensors"} for path in folder.iterdir())
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        self._write("recipe.json", self.recipe)

    def load_samples(self, name: str) -> TrainingData | None:
        """Returns the stored samples, or None if there are none. Raises UserError if they cannot be read."""
        path = self.folder / f"{name}.npz"
        if not path.exists():
            return None
        with self._reading(path), path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            poses, ranges = file["poses"].astype(np.float64), file["ranges"].astype(np.float64)
            if poses.ndim != 2 or ranges.ndim != 2 or poses.shape != (len(ranges), 3):
                raise ValueError(f"poses {poses.shape} and ranges {ranges.shape} do not fit")
            return TrainingData(poses, ranges)

    def save_samples(self, name: str, data: TrainingData) -> None:
        """Stores samples for a later run."""
        path = self.folder / f"{name}.npz"
        with complete_files(path) as partial:
            np.savez(partial / path.name, poses=data.poses, ranges=data.ranges.astype(np.float32))

    def save_state(self, trainer: Trainer) -> None:
        """Stores the state of the training atomically."""
        state = trainer.state()
        tensors = {f"decoder.{name}": tensor.contiguous() for name, tensor in state["decoder"].items()}
        for index, slots in state["optimiser"]["state"].items():
            tensors |= {f"adam.{index}.{name}": tensor.contiguous() for name, tensor in slots.items()}
        # Weights and progress are in one file, so that they are always consistent.
        meta = {"progress": json.dumps(state["progress"])}
        path = self.folder / "state.safetensors"
        with complete_files(path) as partial:
            safetensors.torch.save_file(tensors, partial / path.name, metadata=meta)

    def restore_state(self, trainer: Trainer) -> bool:
        """Restores the stored state; returns False if there is none. Raises UserError if it cannot be read."""
        path = self.folder / "state.safetensors"
        if not path.exists():
            return False
        with self._reading(path):
            trainer.restore(self._state(path, trainer))
        return True

    def _state(self, path: Path, trainer: Trainer) -> dict[str, Any]:
        state = trainer.state()
        with safetensors.safe_open(path, framework="pt") as file:
            progress = json.loads(file.metadata()["progress"])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no mapping
        adam: dict[int, dict[str, Any]] = {}
        for name, tensor in tensors.items():
            if name.startswith("adam."):
                _, index, slot = name.split(".")
                adam.setdefault(int(index), {})[slot] = tensor
        decoder = {name.removeprefix("decoder."): t for name, t in tensors.items() if name.startswith("decoder.")}
        optimiser = {"state": adam, "param_groups": state["optimiser"]["param_groups"]}
        return {"decoder": decoder, "optimiser": optimiser, "progress": progress}

    @contextmanager
    def _reading(self, path: Path) -> Iterator[None]:
        """Converts every error that a damaged file can cause to a UserError."""
        try:
            yield
        except (
            OSError,
            EOFError,
            LookupError,
            ValueError,
            TypeError,
            AttributeError,
            RuntimeError,
            *DAMAGED_FILE_ERRORS,
        ) as error:
            raise UserError(
                f"{path}: the unfinished training cannot be resumed ({' '.join(str(error).split())[:200]}); "
                f"remove {self.folder} and train from the start"
            ) from error

    def finish(self) -> None:
        """Removes the folder, once the weights are written."""
        shutil.rmtree(self.folder)

    def _read(self, name: str) -> Any:
        try:
            return json.loads((self.folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def _write(self, name: str, value: Any) -> None:
        (self.folder / name).write_text(json.dumps(value), encoding="utf-8")
