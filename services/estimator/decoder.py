"""The paper's generative model: two fully connected layers, then transposed convolutions up to the beams.

Burghardt & Lanillos 2021, section 2.3 and figure 2a: pose (x, y) at one fixed heading to expected ranges,
ReLU after every layer, inputs and outputs normalised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import nn

if TYPE_CHECKING:
    from common.se2 import Array

UPSAMPLINGS = 4  # (transposed convolution, convolution) blocks, each doubling the length


class GenerativeModel(Protocol):
    """What the estimator asks of a model: from a pose to the scan expected there."""

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """Ranges g (B,) m expected at base_link pose (3,) in map, and dg (B, 3) by x, y (m/m) and yaw (m/rad)."""
        ...


@dataclass(frozen=True)
class Shape:
    """What fixes the network's size."""

    beams: int
    hidden: int = 128
    channels: int = 16


class Decoder(nn.Module):
    """Normalised position (N, 2) in [-1, 1] to normalised ranges (N, B) >= 0."""

    def __init__(self, shape: Shape) -> None:
        """Random weights, by torch's generator."""
        super().__init__()
        self.shape = shape
        self.start = -(-shape.beams // 2**UPSAMPLINGS)  # length before the first block
        width = shape.channels
        self.fully = nn.Sequential(
            nn.Linear(2, shape.hidden), nn.ReLU(), nn.Linear(shape.hidden, width * self.start), nn.ReLU()
        )
        blocks: list[nn.Module] = []
        for _ in range(UPSAMPLINGS):
            blocks += [nn.ConvTranspose1d(width, width, 4, stride=2, padding=1), nn.ReLU()]
            blocks += [nn.Conv1d(width, width, 3, padding=1), nn.ReLU()]
        self.blocks = nn.Sequential(*blocks)
        self.out = nn.Conv1d(width, 1, 1)
        assert self.out.bias is not None  # noqa: S101 - asked for by default
        nn.init.constant_(self.out.bias, 0.2)  # ReLU at the output: begin where it is alive

    def forward(self, position: torch.Tensor) -> torch.Tensor:
        """(N, 2) to (N, B)."""
        features = self.fully(position).unflatten(1, (self.shape.channels, self.start))
        return torch.relu(self.out(self.blocks(features)))[:, 0, : self.shape.beams]


@dataclass(frozen=True)
class Normalisation:
    """Between metres and the network's numbers."""

    center: tuple[float, float]  # m
    half_size: tuple[float, float]  # m
    range_scale: float  # m, a normalised range of 1

    def position(self, poses: Array, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """(N, 2) in [-1, 1] from poses (N, 3) in map."""
        return torch.as_tensor((poses[:, :2] - np.array(self.center)) / np.array(self.half_size), dtype=dtype)


class PaperModel:
    """A trained decoder in metres; its heading is frozen at the one it was trained for."""

    def __init__(self, decoder: Decoder, norm: Normalisation) -> None:
        """Wrap a decoder for inference."""
        self.decoder, self.norm = decoder.eval().requires_grad_(requires_grad=False), norm
        self.dtype = next(decoder.parameters()).dtype

        def ranges_of(position: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            ranges = self.decoder(position[None])[0]
            return ranges, ranges

        self._with_jacobian = torch.func.jacfwd(ranges_of, has_aux=True)

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """See GenerativeModel; the derivative by yaw is zero, for the paper freezes it."""
        jacobian, ranges = self._with_jacobian(self.norm.position(pose[None], self.dtype)[0])
        full = np.zeros((len(ranges), 3))
        full[:, :2] = jacobian.double().numpy() * self.norm.range_scale / np.array(self.norm.half_size)
        return ranges.double().numpy() * self.norm.range_scale, full

    def ranges(self, poses: Array) -> Array:
        """(N, B) m expected at poses (N, 3)."""
        with torch.no_grad():
            parts = [self.decoder(part) for part in torch.split(self.norm.position(poses, self.dtype), 1000)]
        return torch.cat(parts).double().numpy() * self.norm.range_scale
