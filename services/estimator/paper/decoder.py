"""The paper's decoder network: pose in, scan out.

Burghardt & Lanillos 2021, section 2.3 and figure 2a: pose (x, y) at one fixed heading to expected ranges,
ReLU after every layer, inputs and outputs normalised.
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

UPSAMPLINGS = 4  # (transposed convolution, convolution) blocks, each doubling the length


class GenerativeModel(Protocol):
    """What the estimator asks of a model: from a pose to the scan expected there."""

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """Ranges g (B,) m expected at base_link pose (3,) in map, and dg (B, 3) by x, y (m/m) and yaw (m/rad)."""
        ...

    def predict_all(self, poses: Array) -> tuple[Array, Array]:
        """The same of N poses (N, 3) at once: (N, B) and (N, B, 3)."""
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
        values = position
        for layer in self.layers():
            values = layer(values)
        return values[:, 0, : self.shape.beams]

    def layers(self) -> list[nn.Module]:
        """Every layer in order; each is affine, a ReLU, or the unflattening into channels."""
        unflatten = nn.Unflatten(1, (self.shape.channels, self.start))
        return [*self.fully, unflatten, *self.blocks, self.out, nn.ReLU()]


@dataclass(frozen=True)
class Normalisation:
    """Between metres and the network's numbers."""

    center: tuple[float, float]  # m
    half_size: tuple[float, float]  # m
    range_scale: float  # m, a normalised range of 1

    @classmethod
    def of(cls, bounds: tuple[float, float, float, float], range_scale: float) -> Normalisation:
        """The map's bounds x0, y0, x1, y1 (m) become a square from -1 to 1."""
        x0, y0, x1, y1 = bounds
        return cls(((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2), range_scale)

    @property
    def metric(self) -> Array:
        """(2,) length in m, by axis, of a gradient step in normalised coordinates, relative to the longest axis'."""
        return np.asarray((np.array(self.half_size) / max(self.half_size)) ** 2)

    def position(self, poses: Array, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        """(N, 2) in [-1, 1] from poses (N, 3) in map."""
        return torch.as_tensor((poses[:, :2] - np.array(self.center)) / np.array(self.half_size), dtype=dtype)


class PaperModel:
    """A trained decoder in metres; its heading is frozen at the one it was trained for."""

    def __init__(self, decoder: Decoder, norm: Normalisation) -> None:
        """Wrap a decoder for inference."""
        self.decoder, self.norm = decoder.eval().requires_grad_(requires_grad=False), norm
        self.dtype = next(decoder.parameters()).dtype
        self._forward = ForwardMode(self.decoder.layers())

    def predict(self, pose: Array) -> tuple[Array, Array]:
        """See GenerativeModel; the derivative by yaw is zero, for the paper freezes it."""
        ranges, jacobians = self.predict_all(pose[None])
        return ranges[0], jacobians[0]

    def predict_all(self, poses: Array) -> tuple[Array, Array]:
        """See GenerativeModel."""
        positions = self.norm.position(poses, self.dtype).numpy()
        ranges, tangents = (rows[..., : self.decoder.shape.beams] for rows in self._forward(positions))
        full = np.zeros((*ranges.shape, 3))
        full[..., :2] = tangents.transpose(0, 2, 1) * self.norm.range_scale / np.array(self.norm.half_size)
        return ranges.astype(np.float64) * self.norm.range_scale, full

    def ranges(self, poses: Array) -> Array:
        """(N, B) m expected at poses (N, 3)."""
        with torch.no_grad():
            parts = [self.decoder(part) for part in torch.split(self.norm.position(poses, self.dtype), 1000)]
        return torch.cat(parts).double().numpy() * self.norm.range_scale


def use_one_core() -> None:
    """For inference: a scan is too small to share, and the bytes are the same on any number of cores."""
    torch.set_num_threads(1)
