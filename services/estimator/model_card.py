"""Describes the map and the weights that an estimator uses, for recordings."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.geometry.world import World, load_world
from common.messages.requests import ModelReply
from services.estimator.factory import EstimatorOptions, field_path
from services.estimator.precise.learning import weights as precise_weights
from services.estimator.shared.model_folder import find_folder


@dataclass(frozen=True)
class ModelInUse:
    """The model of an estimator, described when it is loaded, because its files may change later."""

    estimator: str
    world: World  # the estimator's map
    path: Path | None = None  # of the weights; None if the model was not learned
    file: str = ""  # name of the file that `--models FOLDER` expects
    card: str = ""  # JSON text of the model card
    size: int = 0  # bytes of the weights
    sha256: str = ""  # of the weights

    def reply(self, *, weights: bool) -> ModelReply:
        """Returns the reply, with or without the weights. Raises UserError if the weights file has changed since."""
        data = b""
        if weights and self.path is not None:
            data = _read(self.path)
            if hashlib.sha256(data).hexdigest() != self.sha256:
                raise UserError(f"{self.path} was changed since the estimator loaded it: restart the estimator")
        return ModelReply(
            estimator=self.estimator,
            world=self.world,
            card=self.card,
            file=self.file,
            size=self.size,
            sha256=self.sha256,
            weights=np.frombuffer(data, np.uint8),
        )


def model_in_use(options: EstimatorOptions, beams: int | None) -> ModelInUse:
    """Describes the model that the options select, for scans of ``beams`` beams, or None before the first scan.

    Raises UserError if the model is unknown.
    """
    world = options.world if isinstance(options.world, World) else load_world(options.world)
    if options.estimator == "precise" and options.model != "exact":
        path = field_path(options, world)
        if options.model != "learned":  # any file; its map is the world in its card
            world = World.model_validate(json.loads(_card(path))["world"])
        return _learned(options.estimator, world, path, precise_weights.path_of(Path(), world.name).name)
    if options.estimator == "paper":
        if beams is None:
            raise UserError("no scan has come yet: how many beams, and so which weights, is not known")
        # Imported only here, because torch takes a second to import and the other estimators do not need it.
        from services.estimator.paper import weights as paper_weights

        path = paper_weights.nearest(options.models or find_folder(world.name, "paper"), world.name, "paper", beams)
        return _learned(options.estimator, world, path, path.name)
    return ModelInUse(options.estimator, world)


def _learned(estimator: str, world: World, path: Path, file: str) -> ModelInUse:
    data = _read(path)
    digest = hashlib.sha256(data).hexdigest()
    return ModelInUse(estimator, world, path, file, _card(path), len(data), digest)


def _card(path: Path) -> str:
    return _read(path.with_suffix(".json")).decode()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
