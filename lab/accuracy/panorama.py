"""A network that predicts scans, which `presage bench decoders` compares with the distance field.

Position features, fully connected layers, two heads for every direction: expected range and log scale, trained together
by the Laplace negative log-likelihood |o - mu| exp(-b) + b.
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

MIN_LOG_SCALE = -9.0
BATCH_SIZE = 256
DIFFERENCE_STEP = 2e-3  # m; finite differences, because torch has no such derivative for the grids


@dataclass(frozen=True)
class PanoramaShape:
    """Hyperparameters of the network."""

    inputs: Literal["fourier", "grid"] = "fourier"
    activation: Literal["silu", "relu"] = "silu"
    loss: Literal["laplace", "l1"] = "laplace"
    bins: int = 1080  # directions, counter-clockwise from the map's +x axis
    width: int = 512
    layers: int = 4
    frequencies: int = 128
    cells: tuple[float, ...] = (2.0, 1.0, 0.5, 0.25)  # cell sizes of the grids in m, coarse to fine
    features: int = 16  # per grid


class Fourier(nn.Module):
    """Sines and cosines of random projections (Tancik et al. 2020)."""

    projection: torch.Tensor

    def __init__(self, count: int) -> None:
        super().__init__()
        self.register_buffer("projection", torch.randn(2, count) * 2 * math.pi)
        self.out = 2 * count + 2

    def forward(self, p: torch.Tensor) -> torch.Tensor:
        """Maps positions (N, 2) to features (N, 2 count + 2)."""
        z = p @ self.projection
        return torch.cat([p, z.sin(), z.cos()], -1)


class Grids(nn.Module):
    """Learned features on grids of several resolutions, interpolated bilinearly (Müller et al. 2022)."""

    stretch: torch.Tensor

    def __init__(self, shape: PanoramaShape, size: tuple[float, float]) -> None:
        super().__init__()
        self.grids = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(1, shape.features, int(size[1] / cell) + 2, int(size[0] / cell) + 2))
            for cell in shape.cells
        )
        self.register_buffer("stretch", torch.tensor([max(size) / size[0], max(size) / size[1]]))
        self.out = shape.features * len(shape.cells) + 2

    def forward(self, p: torch.Tensor) -> torch.Tensor:
        """Maps positions (N, 2) to features (N, features * grids + 2)."""
        points = (p * self.stretch)[None, :, None, :]
        features = [nn.functional.grid_sample(g, points, align_corners=True)[0, :, :, 0].T for g in self.grids]
        return torch.cat([p, *features], -1)


class Panorama(nn.Module):
    """Maps positions (N, 2) to normalised ranges and log scales (N, bins); the world's longer side is [-1, 1]."""

    def __init__(self, shape: PanoramaShape, size: tuple[float, float]) -> None:
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
        """Returns the expected ranges and the log scales."""
        hidden = self.trunk(self.inputs(p))
        return self.mean(hidden), self.scale(hidden).clamp(MIN_LOG_SCALE, 2)


@dataclass(frozen=True)
class PanoramaModel:
    """A trained panorama, in metres."""

    network: Panorama
    center: Array  # (2,) m
    half: float  # m, half the world's longer side
    range_scale: float  # m
    bins: int

    def expect(self, lasers: Array, angles: Array) -> Expected:
        """See GenerativeModel. Interpolates linearly between the directions of the network."""
        lasers = np.asarray(lasers, float).reshape(-1, 3)
        offsets = np.array(
            [[0, 0], [DIFFERENCE_STEP, 0], [-DIFFERENCE_STEP, 0], [0, DIFFERENCE_STEP], [0, -DIFFERENCE_STEP]]
        )[:, None, :]
        p = torch.as_tensor((lasers[:, :2] + offsets - self.center) / self.half, dtype=torch.float32)
        with torch.no_grad():
            means, scales = self.network(p.reshape(-1, 2))
        shape = (len(offsets), len(lasers), self.bins)
        mean, *shifted = means.reshape(shape).double().numpy() * self.range_scale
        slopes = [(shifted[k] - shifted[k + 1]) / (2 * DIFFERENCE_STEP) for k in (0, 2)]
        # The standard deviation of a Laplace distribution is sqrt(2) times its scale.
        scale = np.exp(scales.reshape(shape)[0].double().numpy()) * self.range_scale * math.sqrt(2)
        u = (lasers[:, 2:3] + angles) * self.bins / (2 * np.pi)
        low = np.floor(u).astype(int)
        share, low, high = u - low, low % self.bins, (low + 1) % self.bins

        def interpolate(values: Array) -> Array:
            a, b = np.take_along_axis(values, low, 1), np.take_along_axis(values, high, 1)
            return np.asarray(a + share * (b - a))

        turn = (np.roll(mean, -1, 1) - np.roll(mean, 1, 1)) * self.bins / (4 * np.pi)
        jacobian = np.stack([interpolate(slopes[0]), interpolate(slopes[1]), interpolate(turn)], -1)
        return Expected(np.maximum(interpolate(mean), 0.0), interpolate(scale), jacobian)

    def expect_behind(self, lasers: Array, angles: Array, ranges: Array) -> Array:  # noqa: ARG002
        """See GenerativeModel. The network knows nothing behind the first surface."""
        return np.full(ranges.shape, np.inf)


def train_panorama(
    shape: PanoramaShape, lasers: Array, angles: Array, ranges: Array, steps: int, seed: int
) -> PanoramaModel:
    """Trains on scans ``ranges`` (N, B), m, taken at ``lasers`` (N, 3), the laser's poses.

    Takes ``steps`` steps of 256 scans each; the learning rate decays to zero along a cosine.
    """
    torch.manual_seed(seed)
    low, high = lasers[:, :2].min(0), lasers[:, :2].max(0)
    center, size = (low + high) / 2, (float(high[0] - low[0]), float(high[1] - low[1]))
    half, range_scale = max(size) / 2, float(ranges.max())
    network = Panorama(shape, size)
    target, seen = _panoramas(shape.bins, lasers[:, 2], angles, ranges / range_scale)
    p = torch.as_tensor((lasers[:, :2] - center) / half, dtype=torch.float32)
    grids = [x for name, x in network.named_parameters() if "grids" in name]
    rest = [x for name, x in network.named_parameters() if "grids" not in name]
    optimiser = torch.optim.Adam([{"params": rest, "lr": 1e-3}] + [{"params": grids, "lr": 1e-2}] * bool(grids))
    initial_rates = [group["lr"] for group in optimiser.param_groups]
    for step in range(steps):
        batch = torch.randint(len(p), (BATCH_SIZE,))
        for group, rate in zip(optimiser.param_groups, initial_rates, strict=True):
            group["lr"] = rate * 0.5 * (1 + math.cos(math.pi * step / steps))
        mean, log_scale = network(p[batch])
        error = (mean - target[batch]).abs()
        loss = error * torch.exp(-log_scale) + log_scale if shape.loss == "laplace" else error + 0 * log_scale
        optimiser.zero_grad()
        ((loss * seen[batch]).sum() / seen[batch].sum()).backward()
        optimiser.step()
    return PanoramaModel(network.eval(), center, half, range_scale, shape.bins)


def _panoramas(bins: int, yaw: Array, angles: Array, ranges: Array) -> tuple[torch.Tensor, torch.Tensor]:
    """Scans (N, B) resampled linearly to panoramas (N, bins), and a mask that is 1 inside the scanner's view."""
    target, seen = np.zeros((len(yaw), bins), np.float32), np.zeros((len(yaw), bins), np.float32)
    directions = np.arange(bins) * 2 * np.pi / bins
    for k, heading in enumerate(yaw):
        within = se2.wrap(directions - heading)
        inside = (within >= angles[0]) & (within <= angles[-1])
        target[k, inside] = np.interp(within[inside], angles, ranges[k])
        seen[k, inside] = 1
    return torch.from_numpy(target), torch.from_numpy(seen)
