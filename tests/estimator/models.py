"""For tests: the exact ray caster as a generative model, and changed weights."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import safetensors.numpy

from common.geometry import se2
from common.geometry.world import World
from common.robot.scanner import SCANNERS
from services.estimator.shared.digest import sha256

ROOM = World(
    name="room",
    boundary=[(0, 0), (6, 0), (6, 4), (0, 4)],
    obstacles=[
        {"box": {"center": (2, 3), "size": (0.6, 0.4), "yaw_deg": 20}},
        {"circle": {"center": (4.5, 3), "radius": 0.4}},
    ],
)
SCANNER = SCANNERS["tim571"].with_beams(64)
HEADING = np.pi / 2


def change_weights(path: Path) -> bytes:
    """Changes the numbers in a file of weights, adapts the digest in its card, and returns the new bytes."""
    data = safetensors.numpy.save(
        {name: (tensor * 1.02).astype(tensor.dtype) for name, tensor in safetensors.numpy.load_file(path).items()}
    )
    path.write_bytes(data)
    card = path.with_suffix(".json")
    card.write_text(json.dumps(json.loads(card.read_text()) | {"weights_sha256": sha256(data)}))
    return data


class ExactModel:
    """The ray caster as a generative model, with derivatives by central differences."""

    def __init__(self, world: World, step: float = 1e-4) -> None:
        self.world, self.step = world, step

    def ranges(self, poses: np.ndarray) -> np.ndarray:
        return self.world.ray_distances(se2.compose(poses, SCANNER.mount), SCANNER.angles())

    def predict(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        offsets = self.step * np.eye(3)
        seen = self.ranges(np.concatenate([pose[None], pose + offsets, pose - offsets]))
        return seen[0], ((seen[1:4] - seen[4:]) / (2 * self.step)).T
