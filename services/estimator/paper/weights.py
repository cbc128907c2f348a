"""The decoder's weights and model card on disk."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any

import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from common.errors import UserError, first_fault
from common.geometry.world import World
from common.robot.scanner import Scanner
from services.estimator.paper.decoder import Decoder, DecoderShape, Normalisation, PaperModel
from services.estimator.shared.digest import check_digest, sha256
from services.estimator.shared.model_folder import write_weights_and_card

PRESET = "paper"


class ModelCard(BaseModel):
    """Model card of a decoder: how it was made, and its errors on test scans."""

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    preset: str
    world: World
    scanner: Scanner
    heading: float  # rad, constant heading of the robot
    samples: int
    epochs: int
    batch: int
    learning_rate: float
    seed: int
    hidden: int
    channels: int
    center: tuple[float, float]  # m
    half_size: tuple[float, float]  # m
    range_scale: float  # m
    test_samples: int
    test_l1_mean: Annotated[float, Field(description="m, mean over beams and test samples")]
    test_l1_median: Annotated[float, Field(description="m, median over beams and test samples")]
    curve_train_l1: list[float]  # m, one per epoch
    curve_test_l1: list[float]  # m
    training_s: float  # wall time
    commit: str
    command: str
    versions: dict[str, str]
    weights_sha256: str = ""  # SHA-256 of the weights file, hexadecimal; empty in older cards

    def shape(self) -> DecoderShape:
        """Size of the network."""
        return DecoderShape(self.scanner.beams, self.hidden, self.channels)

    def normalisation(self) -> Normalisation:
        """Normalisation of the network's inputs and outputs."""
        return Normalisation(self.center, self.half_size, self.range_scale)


def path_of(folder: Path, world: str, beams: int) -> Path:
    """The weights file for a world and number of beams in ``folder``."""
    return folder / f"{world}-{PRESET}-{beams}.safetensors"


def available(folder: Path, world: str) -> dict[int, Path]:
    """The weights files in ``folder``, by number of beams."""
    found = {}
    for path in folder.glob(f"{world}-{PRESET}-*.safetensors"):
        beams = path.stem.rsplit("-", 1)[-1]
        if beams.isdigit():
            found[int(beams)] = path
    return dict(sorted(found.items()))


def train_command(world: str, scanner_options: str = "--scanner tim571") -> str:
    """The command that trains missing weights."""
    return f"presage train --world {shlex.quote(world)} --preset {PRESET} {scanner_options}"


def save(path: Path, decoder: Decoder, card: ModelCard) -> None:
    """Writes the weights, in half precision, and their card."""
    tensors = {name: tensor.detach().half().contiguous() for name, tensor in decoder.state_dict().items()}
    data = safetensors.torch.save(tensors)
    card = card.model_copy(update={"weights_sha256": sha256(data)})
    write_weights_and_card(path, data, card.model_dump_json(indent=1) + "\n")


def load(path: Path) -> tuple[PaperModel, ModelCard]:
    """Returns a trained model and its card. Raises UserError if a file is missing, damaged or inconsistent."""
    try:
        card = ModelCard.model_validate_json(path.with_suffix(".json").read_text(encoding="utf-8"))
        data = path.read_bytes()
        check_digest(path, data, card.weights_sha256, card.command)
        tensors: dict[str, Any] = safetensors.torch.load(data)
        decoder = Decoder(card.shape())
        decoder.load_state_dict({name: tensor.to(torch.float32) for name, tensor in tensors.items()})
    except OSError as error:
        raise UserError(f"weights {path}: cannot be read ({error})") from None
    except ValidationError as error:
        raise UserError(f"model card {path.with_suffix('.json')}: {first_fault(error)}") from None
    except (safetensors.SafetensorError, RuntimeError, ValueError) as error:
        raise UserError(
            f"weights {path}: this is not a file of weights of this network ({' '.join(str(error).split())[:200]})"
        ) from None
    return PaperModel(decoder, card.normalisation()), card


def find(folder: Path, world: str, beams: int) -> Path:
    """The weights file for scans of ``beams`` beams. Raises UserError, with the command that trains it, if missing."""
    known = available(folder, world)
    if beams not in known:
        found = f"there are weights for {', '.join(map(str, known))} beams" if known else f"there are none in {folder}"
        raise UserError(
            f"no weights of preset {PRESET} for world {world!r} and {beams} beams ({found}); "
            f"train them with: {train_command(world, f'--scanner tim571 --beams {beams}')}"
        )
    return known[beams]


def nearest(folder: Path, world: str, beams: int) -> Path:
    """The weights file whose number of beams is nearest to ``beams``. Raises UserError if there are none."""
    known = available(folder, world)
    if not known:
        return find(folder, world, beams)
    return known[min(known, key=lambda count: (abs(count - beams), -count))]
