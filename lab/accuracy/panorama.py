"""A network instead of the distance field, for `bench decoders`.

Position features, fully connected layers, two heads for every direction: expected range and log scale, trained together
by the Laplace negative log-likelihood |o - mu| exp(-b) + b. `presage bench decoders` compares it with the field.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import nn

from common.geometry import se2
from services.estimator.shared.generative_models import Expected

if TYPE_CHECKING:
    from common.geometry.se2 import Array

LEAST_LOG_SCALE = -9.0
BATCH = 256
STEP = 2e-3  # m, of the differences that stand for derivatives: torch has none of its own for grids


@dataclass(frozen=True)
class Shape:
    """What fixes the network."""

    inputs: Literal["fourier", "grid"] = "fourier"
    activation: Literal["silu", "relu"] = "silu"
    loss: Literal["laplace", "l1"] = "laplace"
    bins: int = 1080  # directions, from +x of the map counter-clockwise
    width: int = 512
    layers: int = 4
    frequencies: int = 128
    cells: tuple[float, ...] = (2.0, 1.0, 0.5, 0.25)  # m, of the grids, coarse to fine
    features: int = 16  # of each grid


class Fourier(nn.Module):
    """Sines and cosines of random projections (Tancik et al. 2020)."""

    projection: torch.Tensor

    def __init__(self, count: int) -> None:
        super().__init__()
        self.register_buffer("projection", torch.randn(2, count) * 2 * math.pi)
        self.out = 2 * count + 2

    def forward(self, p: torch.Tensor) -> torch.Tensor:
        """(N, 2) to (N, 2 count + 2)."""
        z = p @ self.projection
        return torch.cat([p, z.sin(), z.cos()], -1)


class Grids(nn.Module):
    """Learned features on grids of several resolutions, interpolated bilinearly (Müller et al. 2022)."""

    stretch: torch.Tensor

    def __init__(self, shape: Shape, size: tuple[float, float]) -> None:
        super().__init__()
        self.grids = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(1, shape.features, int(size[1] / cell) + 2, int(size[0] / cell) + 2))
            for cell in shape.cells
        )
        self.register_buffer("stretch", torch.tensor([max(size) / size[0], max(size) / size[1]]))
        self.out = shape.features * len(shape.cells) + 2

    def forward(self, p: torch.Tensor) -> torch.Tensor:
        """(N, 2) to (N, features * grids + 2)."""
        where = (p * self.stretch)[None, :, None, :]
        found = [nn.functional.grid_sample(g, where, align_corners=True)[0, :, :, 0].T for g in self.grids]
        return torch.cat([p, *found], -1)


class Panorama(nn.Module):
    """Position (N, 2), the longer side of the world in [-1, 1], to ranges and log scales (N, bins), normalised."""

    def __init__(self, shape: Shape, size: tuple[float, float]) -> None:
        super().__init__()
        self.inputs: Fourier | Grids = Fourier(shape.frequencies) if shape.inputs == "fourier" else Grids(shape, size)
        layers: list[nn.Module] = []
        width = self.inputs.out
        for _ in range(shape.layers):
            layers += [nn.Linear(width, shape.width), nn.SiLU() if shape.activation == "silu" else nn.ReLU()]
            width = shape.width
        self.trunk = nn.Sequential(*layers)
        self.mean, self.scale = nn.Linear(width, shape.bins), nn.Linear(width, shape.bins)
        nn.init.zeros_(self.scale.weight)
        nn.init.constant_(self.scale.bias, -1.5)

    def forward(self, p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and log scale."""
        hidden = self.trunk(self.inputs(p))
        return self.mean(hidden), self.scale(hidden).clamp(LEAST_LOG_SCALE, 2)


@dataclass(frozen=True)
class PanoramaModel:
    """A trained panorama in metres."""

    network: Panorama
    center: Array  # (2,) m
    half: float  # m, of the longer side
    range_scale: float  # m
    bins: int
    ripple: float = 0.0  # not known

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel; between directions by linear interpolation."""
        lasers = np.asarray(lasers, float).reshape(-1, 3)
        offsets = np.array([[0, 0], [STEP, 0], [-STEP, 0], [0, STEP], [0, -STEP]])[:, None, :]
        p = torch.as_tensor((lasers[:, :2] + offsets - self.center) / self.half, dtype=torch.float32)
        with torch.no_grad():
            means, scales = self.network(p.reshape(-1, 2))
        shape = (len(offsets), len(lasers), self.bins)
        mean, *shifted = means.reshape(shape).double().numpy() * self.range_scale
        slopes = [(shifted[k] - shifted[k + 1]) / (2 * STEP) for k in (0, 2)]
        # The deviation of Laplace's density is sqrt(2) times its scale.
        scale = np.exp(scales.reshape(shape)[0].double().numpy()) * self.range_scale * math.sqrt(2)
        u = (lasers[:, 2:3] + angles) * self.bins / (2 * np.pi)
        low = np.floor(u).astype(int)
        share, low, high = u - low, low % self.bins, (low + 1) % self.bins

        def between(values: Array) -> Array:
            a, b = np.take_along_axis(values, low, 1), np.take_along_axis(values, high, 1)
            return np.asarray(a + share * (b - a))

        turn = (np.roll(mean, -1, 1) - np.roll(mean, 1, 1)) * self.bins / (4 * np.pi)
        jacobian = np.stack([between(slopes[0]), between(slopes[1]), between(turn)], -1)
        return Expected(np.maximum(between(mean), 0.0), between(scale), jacobian)


def train_panorama(shape: Shape, lasers: Array, angles: Array, ranges: Array, steps: int, seed: int) -> PanoramaModel:
    """From scans (N, B) m at laser poses (N, 3), in ``steps`` of 256 scans; a cosine takes the rate to zero."""
    torch.manual_seed(seed)
    low, high = lasers[:, :2].min(0), lasers[:, :2].max(0)
    center, size = (low + high) / 2, (float(high[0] - low[0]), float(high[1] - low[1]))
    half, range_scale = max(size) / 2, float(ranges.max())
    network = Panorama(shape, size)
    target, seen = _all_around(shape.bins, lasers[:, 2], angles, ranges / range_scale)
    p = torch.as_tensor((lasers[:, :2] - center) / half, dtype=torch.float32)
    grids = [x for name, x in network.named_parameters() if "grids" in name]
    rest = [x for name, x in network.named_parameters() if "grids" not in name]
    optimiser = torch.optim.Adam([{"params": rest, "lr": 1e-3}] + [{"params": grids, "lr": 1e-2}] * bool(grids))
    first = [group["lr"] for group in optimiser.param_groups]
    for step in range(steps):
        batch = torch.randint(len(p), (BATCH,))
        for group, rate in zip(optimiser.param_groups, first, strict=True):
            group["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / steps))
        mean, log_scale = network(p[batch])
        error = (mean - target[batch]).abs()
        loss = error * torch.exp(-log_scale) + log_scale if shape.loss == "laplace" else error + 0 * log_scale
        optimiser.zero_grad()
        ((loss * seen[batch]).sum() / seen[batch].sum()).backward()
        optimiser.step()
    return PanoramaModel(network.eval(), center, half, range_scale, shape.bins)


def _all_around(bins: int, yaw: Array, angles: Array, ranges: Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Scans (N, B) as panoramas (N, bins) by linear interpolation, and 1 where something was seen."""
    target, seen = np.zeros((len(yaw), bins), np.float32), np.zeros((len(yaw), bins), np.float32)
    directions = np.arange(bins) * 2 * np.pi / bins
    for k, heading in enumerate(yaw):
        within = se2.wrap(directions - heading)
        inside = (within >= angles[0]) & (within <= angles[-1])
        target[k, inside] = np.interp(within[inside], angles, ranges[k])
        seen[k, inside] = 1
    return torch.from_numpy(target), torch.from_numpy(seen)
