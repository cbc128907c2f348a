"""The paper's decoder network: pose in, scan out.

Burghardt & Lanillos 2021, section 2.3 and figure 2a: maps a position (x, y), at one fixed heading, to the expected
ranges. There is a ReLU after every layer; inputs and outputs are normalised.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import nn

from services.estimator.paper.forward_mode import ForwardMode

if TYPE_CHECKING:
    from common.geometry.se2 import Array

UPSAMPLING_BLOCKS = 4  # of a transposed convolution and a convolution; each doubles the length


class ScanPredictor(Protocol):
    """Predicts the scan at a pose."""

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """Ranges g (B,) in m at base_link ``pose`` (3,) in map, and dg (B, 3), by x, y (m/m) and yaw (m/rad)."""
        ...


@dataclass(frozen=True)
class DecoderShape:
    """Size of the network."""

    beams: int
    hidden: int = 128
    channels: int = 16


class Decoder(nn.Module):
    """Maps normalised positions (N, 2) in [-1, 1] to normalised ranges (N, B) >= 0."""

    def __init__(self, shape: DecoderShape) -> None:
        """Initialises the weights with torch's random generator."""
        super().__init__()
        self.shape = shape
        self.start = -(-shape.beams // 2**UPSAMPLING_BLOCKS)  # length before the first block
        width = shape.channels
        self.fully = nn.Sequential(
            nn.Linear(2, shape.hidden), nn.ReLU(), nn.Linear(shape.hidden, width * self.start), nn.ReLU()
        )
        blocks: list[nn.Module] = []
        for _ in range(UPSAMPLING_BLOCKS):
            blocks += [nn.ConvTranspose1d(width, width, 4, stride=2, padding=1), nn.ReLU()]
            blocks += [nn.Conv1d(width, width, 3, padding=1), nn.ReLU()]
        self.blocks = nn.Sequential(*blocks)
        self.out = nn.Conv1d(width, 1, 1)
        assert self.out.bias is not None  # noqa: S101 - torch adds a bias by default
        nn.init.constant_(self.out.bias, 0.2)  # so that the ReLU at the output is active at first

    def forward(self, position: torch.Tensor) -> torch.Tensor:
        """Predicts normalised ranges (N, B) at positions (N, 2)."""
        values = position
        for layer in self.layers():
            values = layer(values)
        return values[:, 0, : self.shape.beams]

    def layers(self) -> list[nn.Module]:
        """All layers in order; each is affine, a ReLU, or the unflattening into channels."""
        unflatten = nn.Unflatten(1, (self.shape.channels, self.start))
        return [*self.fully, unflatten, *self.blocks, self.out, nn.ReLU()]


@dataclass(frozen=True)
class Normalisation:
    """Converts between metres and the network's normalised numbers."""

    center: tuple[float, float]  # m
    half_size: tuple[float, float]  # m
    range_scale: float  # m, range that is normalised to 1

    @classmethod
    def of(cls, bounds: tuple[float, float, float, float], range_scale: float) -> Normalisation:
        """Maps the bounds x0, y0, x1, y1 (m) of a world to the square from -1 to 1."""
        x0, y0, x1, y1 = bounds
        return cls(((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2), range_scale)

    @property
    def metric(self) -> Array:
        """Scale (2,) of a gradient step in x and y, relative to the map's longest axis.

        It is the squared ratio of half sizes: that of a step in normalised coordinates, expressed in m.
        """
        return np.asarray((np.array(self.half_size) / max(self.half_size)) ** 2)

    def position(self, poses: Array, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """Normalised positions (N, 2) in [-1, 1] of poses (N, 3) in map."""
        return torch.as_tensor(self.normalised(poses), dtype=dtype)

    def normalised(self, poses: Array) -> Array:
        """The same as `position`, in double precision, for poses (..., 3)."""
        return np.asarray((poses[..., :2] - self.center) / self.half_size)


class PaperModel:
    """A trained decoder with ranges in metres, for the one heading of its training."""

    def __init__(self, decoder: Decoder, norm: Normalisation) -> None:
        """Prepares a decoder for inference."""
        self.decoder, self.norm = decoder.eval().requires_grad_(requires_grad=False), norm
        self.dtype = next(decoder.parameters()).dtype
        self._forward = ForwardMode(self.decoder.layers())

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """Predicts a scan (see ScanPredictor); the derivative by yaw is zero, because the heading is constant."""
        ranges, tangents = (rows[..., : self.decoder.shape.beams] for rows in self._forward(self.norm.normalised(pose)))
        full = np.zeros((len(ranges), 3))
        full[:, :2] = tangents.T * self.norm.range_scale / self.norm.half_size
        return ranges.astype(np.float64) * self.norm.range_scale, full

    def ranges(self, poses: Array) -> Array:
        """Ranges (N, B) in m at poses (N, 3), without derivatives."""
        with torch.no_grad():
            parts = [self.decoder(part) for part in torch.split(self.norm.position(poses, self.dtype), 1000)]
        return torch.cat(parts).double().numpy() * self.norm.range_scale


def use_one_core() -> None:
    """Makes torch use one thread for inference.

    A scan is too small to divide, and so results are the same to the byte on any number of cores.
    """
    torch.set_num_threads(1)
