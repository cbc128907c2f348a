"""Describes the map and the weights that an estimator uses, for recordings."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from common.errors import UserError
from common.geometry.world import World
from common.messages.requests import FILE_NAME, ModelReply
from common.versions import commit, versions
from services.estimator.factory import EstimatorOptions, ScannerGeometry, field_path
from services.estimator.precise.learning import weights as precise_weights
from services.estimator.precise.learning.live_learning import RECIPE, ModelVersion
from services.estimator.shared.digest import sha256
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
            if sha256(data) != self.sha256:
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
    world = options.loaded_world
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

        path = paper_weights.nearest(options.models or find_folder(world.name, "paper"), world.name, beams)
        return _learned(options.estimator, world, path, path.name)
    return ModelInUse(options.estimator, world)


def save_learned(
    folder: Path, name: str, original: ModelInUse, version: ModelVersion, geometry: ScannerGeometry
) -> Path:
    """Writes a version of the model that was learned while driving; returns its path. Raises UserError if that fails.

    Its calibration is that of the original model, if that has one.
    """
    if re.fullmatch(FILE_NAME, name) is None:
        raise UserError(f"name {name!r}: give up to 64 letters, digits, - and _")
    path, field, errors = precise_weights.path_of(folder.resolve(), name), version.model.field, version.errors
    if existing := next((file for file in (path, path.with_suffix(".json")) if file.exists()), None):
        raise UserError(f"{existing} exists already: choose another name")
    card_before = precise_weights.FieldCard.model_validate_json(original.card) if original.card else None
    card = precise_weights.FieldCard(
        world=original.world,
        scanner=geometry.scanner("learned while driving") if card_before is None else card_before.scanner,
        samples=len(version.key_poses),
        seed=RECIPE.seed,
        resolution=field.resolution,
        origin=field.origin,
        sweeps=RECIPE.sweeps,
        inflation=1.0 if card_before is None else card_before.inflation,
        test_samples=version.test_scans,
        test_range_error_median_m=float(np.median(errors)),
        test_range_error_mean_m=float(errors.mean()),
        test_share_above_5_cm=float((errors > 0.05).mean()),
        test_position_error_rms_m=None,
        learning_s=0.0,
        source=f"{len(version.key_poses)} key scans while driving; elsewhere {original.file or 'the map'}",
        calibration=None if card_before is None else card_before.calibration,
        measured=True,
        commit=commit(),
        command=f"presage save-model {name}",
        versions=versions(),
    )
    try:
        precise_weights.write(path, version.model, version.seeds, card)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}): free space, or start the estimator with another folder "
            "(PRESAGE_ESTIMATOR_SAVED_MODELS)"
        ) from None
    return path


def _learned(estimator: str, world: World, path: Path, file: str) -> ModelInUse:
    data = _read(path)
    return ModelInUse(estimator, world, path, file, _card(path), len(data), sha256(data))


def _card(path: Path) -> str:
    return _read(path.with_suffix(".json")).decode()


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
