"""Ranges from pybullet against the exact ray caster over the same world."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import known_worlds, load_world
from common.robot.scanner import SCANNERS
from services.simulator.simulation import Setup, Simulation

SCANNER = SCANNERS["tim571"]
MM = 1e-3


@cache
def simulation(name: str) -> Simulation:
    return Simulation(Setup(load_world(name), SCANNER))


@pytest.mark.parametrize("name", known_worlds())
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_ranges_match_to_a_millimetre(name, seed):
    """Where a beam grazes an edge, the range of any beam within 1 mm of it is a correct result."""
    world, rng = load_world(name), np.random.default_rng(seed)
    poses = np.column_stack([world.sample_free(2, rng, 0.27), rng.uniform(-np.pi, np.pi, 2)])
    seen = simulation(name).sample(poses, None, None)
    lasers = se2.compose(poses, np.array(SCANNER.mount))
    exact = world.ray_distances(lasers, SCANNER.angles())
    off = np.abs(seen - exact) > MM
    for row, beam in np.argwhere(off):
        sideways = MM / min(seen[row, beam], exact[row, beam])
        turned = SCANNER.angles()[beam] + np.linspace(-sideways, sideways, 41)
        near = world.ray_distances(lasers[row : row + 1], turned)[0]
        assert near.min() - MM <= seen[row, beam] <= near.max() + MM, (poses[row], beam)
    assert off.mean() < 0.01  # few beams graze an edge


def test_range_limits_give_plus_and_minus_infinity():
    short = SCANNER.model_copy(update={"range_max": 3.0, "range_min": 1.0, "sigma": 0.0})
    world = load_world("corridor")
    made = Simulation(Setup(world, short))
    exact = world.ray_distances(se2.compose(np.array([[3.0, 1.5, 0.0]]), np.array(short.mount)), short.angles())[0]
    seen = made.sample(np.array([[3.0, 1.5, 0.0]]), None, None)[0]
    assert np.isposinf(seen[exact > 3.001]).all()
    assert np.isneginf(seen[exact < 0.999]).all()
    assert np.isfinite(seen[(exact > 1.001) & (exact < 2.999)]).all()
    made.close()


def test_noise_has_the_scanner_s_sigma_and_a_seed():
    pose = np.tile([[3.0, 1.5, 1.0]], (20, 1))
    clean = simulation("corridor").sample(pose, 622, None)
    a, b, c = (simulation("corridor").sample(pose, 622, seed) for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)
    assert np.std(a - clean) == pytest.approx(SCANNER.sigma, rel=0.02)
    assert abs(np.mean(a - clean)) < 0.001


def test_sample_inside_a_wall_is_refused():
    with pytest.raises(UserError, match=r"1 of 2 poses .* such as \(6\.80, 3\.95\)"):
        simulation("corridor").sample(np.array([[3.0, 1.5, 0.0], [6.8, 3.95, 0.0]]), None, None)


def test_sample_does_not_disturb_the_run():
    plain, disturbed = (Simulation(Setup(load_world("corridor"), SCANNER, seed=5)) for _ in range(2))
    for _ in range(3):
        disturbed.sample(np.array([[9.0, 1.0, 0.0]]), None, 3)
        assert plain.observe() == disturbed.observe()
        plain.advance()
        disturbed.advance()
    plain.close()
    disturbed.close()
