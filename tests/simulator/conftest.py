"""Simulations that are closed after the test."""

from __future__ import annotations

import pytest

from services.simulator.simulation import Simulation, SimulationSetup
from tests.simulator.driving import HALL, SCANNER, shipped


@pytest.fixture
def make():
    made = []

    def build(world=HALL, scanner=SCANNER, **settings) -> Simulation:
        world = shipped(world) if isinstance(world, str) else world
        made.append(Simulation(SimulationSetup(world, scanner, **settings)))
        made[-1].observe()
        return made[-1]

    yield build
    for simulation in made:
        simulation.close()
