"""A field learned in seconds from noisy scans of a small room: errors, stated precision, repeatability, files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import World
from services.estimator.precise.field import FieldModel
from services.estimator.precise.global_seeds import Seeds
from services.estimator.precise.learning import field_learning, surfaces, weights
from services.estimator.precise.learning.evaluation import evaluate_model
from services.estimator.precise.learning.field_learning import Recipe, learn_field, learn_scales
from services.estimator.precise.learning.surfaces import Beams, SurfaceCells, field_of_surfaces
from services.estimator.shared.digest import sha256
from tests.estimator.models import ROOM, SCANNER

ANGLES = np.deg2rad(np.linspace(-135, 135, 271))
NONE = np.zeros(3)
RECIPE = Recipe(resolution=0.05, sweeps=4, beams_per_sweep=60_000)


def scans(count, seed, sigma):
    rng = np.random.default_rng(seed)
    poses = np.column_stack([ROOM.sample_free(count, rng, 0.2), rng.uniform(-np.pi, np.pi, count)])
    return poses, ROOM.ray_distances(poses, ANGLES) + sigma * rng.standard_normal((count, len(ANGLES)))


def learned(seed=0, **options):
    poses, ranges = scans(400, seed, 0.02)
    return learn_field(Beams.of(poses, NONE, ANGLES, ranges), RECIPE, **options)


@pytest.fixture(scope="module")
def model():
    field = learned()
    poses, ranges = scans(150, 1, 0.0)
    return FieldModel(field, learn_scales(field, poses, NONE, ANGLES, ranges, 0.0))


def test_error_on_new_scans(model):
    poses, clean = scans(100, 2, 0.0)
    error = np.abs(model.expect(poses, ANGLES).ranges - clean)
    assert np.median(error) < 0.003  # the scans it learned from had noise of 0.02 m
    assert (error > 0.05).mean() < 0.02


def test_stated_precision(model):
    poses, clean = scans(100, 3, 0.0)
    expected = model.expect(poses, ANGLES)
    error = np.abs(expected.ranges - clean)
    sure = expected.scale < 0.01
    assert sure.mean() > 0.7
    assert error[~sure].mean() > 10 * error[sure].mean()
    # Most errors are within three of the stated deviations of model and scanner.
    assert (error < 3 * np.hypot(expected.scale, 0.02)).mean() > 0.97


def test_same_result_again():
    """With any number of threads."""
    assert np.array_equal(learned().phi, learned(threads=3).phi)


def test_beams_in_parts(model, monkeypatch):
    monkeypatch.setattr(surfaces, "BEAMS_AT_ONCE", 7000)
    assert np.allclose(learned().phi, model.field.phi, atol=1e-6)
    assert not np.array_equal(learned().phi, learned(seed=5).phi)


def test_position_error(model):
    poses, clean = scans(60, 4, 0.0)
    errors = evaluate_model(model, poses, NONE, ANGLES, clean, 25.0, 0.02)
    assert errors.position_error_rms < 0.003
    assert 1 <= errors.inflation < 1.5
    assert errors.range_error_median < 0.003


def test_spike_in_free_space():
    """A node that beams pass becomes free before the sweeps; those on and behind surfaces keep their values."""
    poses, ranges = scans(400, 0, 0.02)
    beams = Beams.of(poses, NONE, ANGLES, ranges)
    field = field_of_surfaces(beams, RECIPE.resolution)
    rows, columns = np.indices(field.phi.shape)
    clearance = ROOM.clearance(np.array(field.origin) + 0.05 * np.stack([columns.ravel(), rows.ravel()], axis=-1))
    beside = (clearance > 0.04) & (clearance < 0.1)
    spiky = np.where(beside.reshape(rows.shape), np.float32(-0.03), field.phi)
    cleared = field_learning._clear_passed_nodes(replace(field, phi=spiky), beams, 2).ravel()
    assert (cleared[beside] > 0).mean() > 0.95
    assert np.array_equal(cleared[clearance < 0], field.phi.ravel()[clearance < 0])


@pytest.mark.parametrize("turn", np.deg2rad([0, 90, 180, 270]))
def test_removed_wall_seen_from_outside(turn):
    """Beams that start outside of the former model's grid contradict its wall, on each of its sides."""
    x, noise = np.linspace(0.0, 2.0, 201), np.random.default_rng(0).normal(0.0, 0.01, 201)
    near, far = (se2.rotate(turn, np.column_stack([x, np.full(201, y)])) for y in (0.0, 9.0))
    inside = Beams(near, np.full(201, turn + np.pi / 2), 1.05 + noise)
    outside = Beams(far, np.full(201, turn - np.pi / 2), np.full(201, 9.0))
    cells = SurfaceCells.of(inside, 0.1)
    assert cells.at(cells.contradicted_by(outside), inside.ends()).mean() > 0.9
    assert not cells.contradicted_by(replace(outside, starts=far + 5.0)).any()


def test_beams_without_return():
    ranges = np.array([[1.0, np.inf, -np.inf, 2.0]])
    beams = Beams.of(np.array([[1.0, 2.0, np.pi / 2]]), NONE, np.array([0.0, 0.1, 0.2, 0.3]), ranges)
    assert beams.ranges.tolist() == [1.0, 2.0]
    assert beams.ends()[0] == pytest.approx([1.0, 3.0])


PLACES = np.stack(np.meshgrid(np.arange(0.25, 6, 0.5), np.arange(0.25, 4, 0.5)), axis=-1).reshape(-1, 2)


def card(model, **changes):
    values = {
        "world": ROOM, "scanner": SCANNER, "samples": 400, "seed": 0, "resolution": model.field.resolution,
        "origin": model.field.origin, "sweeps": 4, "inflation": 1.1, "test_samples": 60,
        "test_range_error_median_m": 0.001, "test_range_error_mean_m": 0.01, "test_share_above_5_cm": 0.01,
        "test_position_error_rms_m": 0.001, "learning_s": 1.0, "commit": "c", "command": "presage train",
        "versions": {},
    }  # fmt: skip
    return weights.FieldCard(**{**values, **changes})


def test_older_card(model):
    assert card(model, ripple=0.01) == card(model)


def saved(model, folder):
    path = weights.path_of(folder, "room")
    weights.save(path, model, PLACES, card(model))
    return path


def test_saved_and_loaded(model, tmp_path):
    path = saved(model, tmp_path)
    back, seeds, read = weights.load(path)
    assert read == card(model).model_copy(update={"weights_sha256": sha256(path.read_bytes())})
    assert np.array_equal(seeds.places, PLACES)
    assert np.array_equal(seeds.panoramas, Seeds.at(back, PLACES).panoramas)
    assert np.array_equal(np.abs(back.field.phi), np.abs(model.field.phi).astype(np.float16).astype(np.float32))
    poses, _ = scans(20, 6, 0.0)
    off = np.abs(back.expect(poses, ANGLES).ranges - model.expect(poses, ANGLES).ranges)
    assert np.quantile(off, 0.98) < 5e-4  # half precision is most exact near zero, at surfaces
    assert weights.find(tmp_path, ROOM, "room") == path


def test_other_walls(model, tmp_path):
    saved(model, tmp_path)
    other = World(name="room", boundary=ROOM.boundary, obstacles=ROOM.obstacles[:1])
    with pytest.raises(UserError, match="another world of the same name 'room'"):
        weights.find(tmp_path, other, "mine.yaml")
    path = weights.path_of(tmp_path, "room")
    with pytest.raises(UserError, match="Replace it with --force if you have changed the world"):
        weights.refuse_to_overwrite(path, other)
    weights.refuse_to_overwrite(path, other, force=True)
    with pytest.raises(UserError, match=f"presage train --world mine.yaml --preset precise --out {tmp_path}"):
        weights.find(tmp_path, World(name="hall", boundary=ROOM.boundary), "mine.yaml")
