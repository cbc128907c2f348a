"""Scans on which tests train a small decoder in seconds."""

from __future__ import annotations

import numpy as np

from common.geometry.world import World
from services.estimator.paper.decoder import Normalisation
from services.estimator.paper.training import TrainingData
from tests.estimator.models import HEADING, ROOM, ExactModel


def posed_scans(count: int, seed: int, world: World = ROOM) -> TrainingData:
    """Scans from random places at one heading."""
    places = world.sample_free(count, np.random.default_rng(seed), 0.3)
    poses = np.column_stack([places, np.full(count, HEADING)])
    return TrainingData(poses, ExactModel(world).ranges(poses))


def normalisation(world: World = ROOM) -> Normalisation:
    x0, y0, x1, y1 = world.bounds
    return Normalisation(((x0 + x1) / 2, (y0 + y1) / 2), ((x1 - x0) / 2, (y1 - y0) / 2), 6.0)
