"""The field's weights and model card on disk."""

from __future__ import annotations

import shlex
import zlib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import safetensors.numpy
from pydantic import BaseModel, ConfigDict, ValidationError

from common.errors import UserError, first_fault
from common.geometry.world import World
from common.robot.scanner import Scanner
from services.estimator.precise.field import CLASSES, DistanceField, FieldModel
from services.estimator.precise.global_seeds import RANKED_HEADINGS, Seeds
from services.estimator.precise.learning.calibration import Calibration
from services.estimator.shared.digest import check_digest, sha256
from services.estimator.shared.model_folder import SHIPPED, training_folder, write_weights_and_card
from services.estimator.shared.seen_cells import SeenCells

if TYPE_CHECKING:
    from common.geometry.se2 import Array

PRESET = "precise"
MAX_DECODED_BYTES = 1 << 28  # of a field that was received; enough for 30 hectares
Tensors = dict[str, np.ndarray[tuple[int, ...], np.dtype[np.generic]]]


class FieldCard(BaseModel):
    """Model card of a field: how it was made, and its errors on test scans."""

    model_config = ConfigDict(frozen=True, extra="ignore")  # older model cards have more fields

    preset: str = PRESET
    world: World
    scanner: Scanner  # used for learning; the field can predict scans of any other
    samples: int
    seed: int
    resolution: float  # m
    origin: tuple[float, float]  # m
    sweeps: int  # steps of gradient descent, each on a sample of the beams
    inflation: float  # factor on the covariance, because errors of the model are correlated between beams
    test_samples: int
    test_range_error_median_m: float
    test_range_error_mean_m: float
    test_share_above_5_cm: float
    # of poses found from scans without noise, so caused by the model alone; None if it was not measured
    test_position_error_rms_m: float | None
    learning_s: float
    source: str = "simulated scans"
    calibration: Calibration | None = None  # on real scans; None if the estimator's defaults hold
    # whether the field shows surfaces where the robot's scans did, not where the cells of a grid have them
    measured: bool = False
    commit: str
    command: str
    versions: dict[str, str]
    weights_sha256: str = ""  # SHA-256 of the weights file, hexadecimal; empty in older cards


def path_of(folder: Path, world: str) -> Path:
    """The file of a world's field in ``folder``."""
    return folder / f"{world}-{PRESET}.safetensors"


def save(path: Path, model: FieldModel, places: Array, card: FieldCard) -> None:
    """Writes the field, the seeds of a search at ``places`` (S, 2) m, and the card.

    The field is stored in half precision, whose resolution is finest near zero, at surfaces.
    """
    places = np.asarray(places, np.float32).astype(np.float64)  # rounded as they will be stored and read
    model = replace(model, field=model.field.as_stored().with_solids(places))
    write(path, model, Seeds.at(model, places), card)


def write(path: Path, model: FieldModel, seeds: Seeds, card: FieldCard) -> None:
    """Writes a field whose solid parts are marked, the seeds of a search and the card."""
    data = safetensors.numpy.save({**_tensors(model, seeds.places), "panoramas_in_bytes": seeds.panoramas})
    card = card.model_copy(update={"weights_sha256": sha256(data)})
    write_weights_and_card(path, data, card.model_dump_json(indent=1) + "\n")


def encode(model: FieldModel, places: Array) -> bytes:
    """The field, and the ``places`` (S, 2) m of the seeds of a search, as compressed bytes without a card."""
    grid = {"grid": np.array([*model.field.origin, model.field.resolution])}
    return zlib.compress(safetensors.numpy.save({**_tensors(model, places), **grid}))


def decode(data: bytes) -> tuple[FieldModel, Seeds]:
    """The model and the seeds from what `encode` returned. Raises ValueError if they are invalid or too large."""
    try:
        tensors = safetensors.numpy.load(zlib.decompressobj().decompress(data, MAX_DECODED_BYTES))
        _check_arrays(tensors)
        x, y, resolution = tensors["grid"][:3].astype(float).tolist()  # older models have one number more
    except (zlib.error, safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"not a field: {error}") from None
    if not (np.isfinite([x, y, resolution]).all() and resolution > 0):
        raise ValueError("the grid of the field is not valid")
    field = DistanceField(tensors["phi"].astype(np.float32), (x, y), resolution)
    model = FieldModel(field, tensors["scales"].astype(np.float64), _seen(tensors))
    return model, Seeds.at(model, tensors["places"].astype(np.float64))


def _tensors(model: FieldModel, places: Array) -> Tensors:
    tensors: Tensors = {
        "phi": model.field.phi.astype(np.float16),
        "scales": model.scales.astype(np.float32),
        "places": places.astype(np.float32),
    }
    if model.seen is not None:
        tensors |= {"seen": model.seen.cells.astype(np.uint8), "seen_origin": np.array(model.seen.origin)}
    return tensors


def _check_arrays(tensors: Tensors) -> None:
    """Raises ValueError unless the arrays of a field have their shapes and are finite."""
    phi, scales, places = (tensors[name] for name in ("phi", "scales", "places"))
    panoramas = tensors.get("panoramas_in_bytes")
    if (
        phi.ndim != 2
        or min(phi.shape) < 2
        or scales.shape != (int(np.prod(CLASSES)),)
        or places.shape[1:] != (2,)
        or not len(places)
        or (panoramas is not None and panoramas.shape != (len(places), 2, RANKED_HEADINGS))
    ):
        raise ValueError("an array does not have the shape that a field needs")
    if not all(np.isfinite(a).all() for a in (phi, scales, places)):
        raise ValueError("an array contains NaN or infinity")
    if "seen" in tensors:
        cells, origin = tensors["seen"], tensors.get("seen_origin", np.zeros(0))
        if cells.ndim != 2 or origin.shape != (2,) or not np.isfinite(origin.astype(float)).all():
            raise ValueError("the grid of seen cells does not have the expected shape")


def load(path: Path) -> tuple[FieldModel, Seeds, FieldCard]:
    """Returns the model, the seeds of a search, and the card.

    Raises UserError if a file is missing, damaged or inconsistent.
    """
    card = _load_card(path)
    try:
        data = path.read_bytes()
        check_digest(path, data, card.weights_sha256, card.command)
        tensors = safetensors.numpy.load(data)
        phi, scales, places = tensors["phi"], tensors["scales"], tensors["places"]
        panoramas = tensors.get("panoramas_in_bytes")  # files written by older versions have none
        if panoramas is not None and panoramas.ndim == 4:  # written by older versions, with three times the directions
            panoramas = tensors["panoramas_in_bytes"] = np.ascontiguousarray(panoramas[:, :, 0])
    except OSError as error:
        raise UserError(f"weights {path}: cannot be read ({error})") from None
    except (safetensors.SafetensorError, KeyError, IndexError, ValueError) as error:
        raise UserError(
            f"weights {path}: this is not a file of field weights ({' '.join(str(error).split())[:200]})"
        ) from None
    try:
        _check_arrays(tensors)
    except ValueError as error:
        raise UserError(f"weights {path}: {error}") from None
    field, places = DistanceField(phi.astype(np.float32), card.origin, card.resolution), places.astype(np.float64)
    if panoramas is None:
        field = field.with_solids(places)
    model = FieldModel(field, scales.astype(np.float64), _seen(tensors))
    return model, Seeds.at(model, places) if panoramas is None else Seeds(places, panoramas), card


def _load_card(path: Path) -> FieldCard:
    try:
        return FieldCard.model_validate_json(path.with_suffix(".json").read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"weights {path}: cannot be read ({error})") from None
    except ValidationError as error:
        raise UserError(f"model card {path.with_suffix('.json')}: {first_fault(error)}") from None


def _seen(tensors: Tensors) -> SeenCells | None:
    if "seen" not in tensors:
        return None
    x, y = tensors["seen_origin"].astype(float).tolist()
    return SeenCells(tensors["seen"].astype(bool), (x, y))


def train_command(world: str, folder: Path = SHIPPED) -> str:
    """The command that trains the field of a world."""
    out = "" if folder in (SHIPPED, training_folder()) else f" --out {shlex.quote(str(folder))}"
    return f"presage train --world {shlex.quote(world)} --preset {PRESET}{out}"


def find(folder: Path, world: World, world_argument: str) -> Path:
    """Returns the file of a world's field; ``world_argument`` is how the user named the world.

    Raises UserError, with the command that trains the field, if there is none or its world differs.
    """
    path = path_of(folder, world.name)
    if not path.exists():
        raise UserError(
            f"no weights for world {world.name!r} in {folder}; train them with: "
            f"{train_command(world_argument, folder)}; or give the file that holds them with --model "
            "FILE.safetensors; or use --model exact, which casts rays in the world itself and needs no training"
        )
    if not same_walls(_load_card(path).world, world):
        raise UserError(
            f"{path} was trained in another world of the same name {world.name!r}: its walls differ. If you have "
            f"changed the world, train it again with: {train_command(world_argument, folder)} --force; otherwise "
            "rename your world"
        )
    return path


def refuse_to_overwrite(path: Path, world: World, *, force: bool = False) -> None:
    """Raises UserError if ``path`` holds the field of another world with the same name, unless ``force`` is true."""
    if force:
        return
    try:
        card = _load_card(path)
    except UserError:
        return
    if not same_walls(card.world, world):
        raise UserError(
            f"{path} belongs to another world of the same name {world.name!r}. Replace it with --force if you have "
            "changed the world, otherwise rename your world, or write to another folder with --out"
        )


def same_walls(a: World, b: World) -> bool:
    """Whether two worlds have the same walls and obstacles."""
    return np.array_equal(a.segments, b.segments) and np.array_equal(a.circles, b.circles)
