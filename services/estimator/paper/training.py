"""Trains the decoder on posed scans (L1 loss, Adam)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from services.estimator.paper.decoder import Decoder, DecoderShape, Normalisation, PaperModel

if TYPE_CHECKING:
    from common.geometry.se2 import Array


@dataclass(frozen=True)
class TrainingParameters:
    """Parameters of training."""

    epochs: int = 60
    batch: int = 500
    learning_rate: float = 2e-3  # at first; decreases to zero along half a cosine
    seed: int = 0


@dataclass
class Progress:
    """Progress of a training, from which it can resume."""

    epoch: int = 0
    train_l1: list[float] = field(default_factory=list)  # m, mean over beams, one per epoch
    test_l1: list[float] = field(default_factory=list)  # m


class Trainer:
    """Trains a decoder epoch by epoch.

    With `state` and `restore` an interrupted run can resume, and ends with the same weights.
    """

    def __init__(
        self,
        shape: DecoderShape,
        norm: Normalisation,
        parameters: TrainingParameters,
        train: TrainingData,
        test: TrainingData,
    ) -> None:
        """The same seed and samples give the same weights on one machine."""
        torch.manual_seed(parameters.seed)
        self.parameters, self.norm = parameters, norm
        self.decoder = Decoder(shape)
        self.optimiser = torch.optim.Adam(self.decoder.parameters(), parameters.learning_rate)
        self.progress = Progress()
        self._train, self._test = train.tensors(norm), test.tensors(norm)

    def run(self, report: Callable[[Progress], None] = lambda _: None) -> PaperModel:
        """Trains the remaining epochs; ``report`` is called after each epoch."""
        while self.progress.epoch < self.parameters.epochs:
            self._epoch()
            report(self.progress)
        return PaperModel(self.decoder, self.norm)

    def _epoch(self) -> None:
        parameters, epoch = self.parameters, self.progress.epoch
        positions, ranges = self._train
        # The order depends only on seed and epoch, so that a resumed run has the same batches.
        order = torch.randperm(
            len(positions), generator=torch.Generator().manual_seed(parameters.seed * 100_003 + epoch)
        )
        batches = torch.split(order, parameters.batch)
        total = 0.0
        self.decoder.train()
        for number, batch in enumerate(batches):
            done = (epoch + number / len(batches)) / parameters.epochs
            for group in self.optimiser.param_groups:
                group["lr"] = parameters.learning_rate * 0.5 * (1 + np.cos(np.pi * done))
            loss = (self.decoder(positions[batch]) - ranges[batch]).abs().mean()
            self.optimiser.zero_grad()
            loss.backward()
            self.optimiser.step()
            total += loss.item() * len(batch)
        self.progress.train_l1.append(total / len(positions) * self.norm.range_scale)
        self.progress.test_l1.append(self._test_l1())
        self.progress.epoch += 1

    def _test_l1(self) -> float:
        positions, ranges = self._test
        self.decoder.eval()
        with torch.no_grad():
            total: float = sum(
                (self.decoder(p) - r).abs().sum().item()
                for p, r in zip(torch.split(positions, 1000), torch.split(ranges, 1000), strict=True)
            )
        return total / ranges.numel() * self.norm.range_scale

    def state(self) -> dict[str, Any]:
        """Returns the state for `restore`, as tensors and plain numbers."""
        return {
            "decoder": self.decoder.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "progress": vars(self.progress),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a state returned by `state`."""
        self.decoder.load_state_dict(state["decoder"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.progress = Progress(**state["progress"])


@dataclass(frozen=True)
class TrainingData:
    """Scans with known poses: poses (N, 3) of base_link in map, ranges (N, B) m."""

    poses: Array
    ranges: Array

    def tensors(self, norm: Normalisation) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns normalised positions (N, 2) and ranges (N, B)."""
        return norm.position(self.poses), torch.as_tensor(self.ranges / norm.range_scale, dtype=torch.float32)


def usable_ranges(ranges: Array, range_max: float) -> Array:
    """Replaces ranges that are not finite, for the network: no return by ``range_max`` m, not measured (-inf) by 0."""
    return np.clip(np.where(np.isposinf(ranges), range_max, np.nan_to_num(ranges)), 0.0, range_max)
