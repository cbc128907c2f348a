"""A new version of a model, from key scans of a drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from common.geometry import se2
from common.geometry.world import World
from lab.integrity.maps import grid_of
from services.estimator.precise.field import FieldModel
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.drive_learning import HELD_OUT_EVERY, absolute_range_errors
from services.estimator.precise.learning.field_learning import Recipe, learn_field
from services.estimator.precise.learning.live_learning import learn_version, mean_error, remove_moving_objects
from services.estimator.precise.learning.map_alignment import align_to_map
from services.estimator.precise.learning.surfaces import Beams
from services.estimator.shared.generative_models import RayCaster

SHELL = {"name": "rooms", "boundary": [(0, 0), (8, 0), (8, 4), (0, 4)]}
WALL = {"polygon": [(4, 0), (4.1, 0), (4.1, 2.8), (4, 2.8)]}  # between two rooms, with a door


def rooms(*boxes):
    return World(obstacles=[WALL, *({"box": {"center": at, "size": (0.6, 0.6)}} for at in boxes)], **SHELL)


BEFORE, AFTER = rooms((2, 1), (6, 1)), rooms((1, 2.6), (6, 1))
ANGLES, SIGMA = np.linspace(-np.pi, np.pi, 180, endpoint=False), 0.01
RECIPE = Recipe(0.05, sweeps=4, beams_per_sweep=30_000)


def drive(world, low, high, count, seed=0, people=()):
    """Scans at true places between two corners. ``people`` are (place, first, last) of stamps."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(low, high, (30 * count, 2))
    places = places[(BEFORE.clearance(places) > 0.2) & (AFTER.clearance(places) > 0.2)][:count]
    poses, stamps = np.column_stack([places, rng.uniform(-3, 3, count)]), 0.8 * np.arange(count)
    ranges = []
    for pose, stamp in zip(poses, stamps, strict=True):
        there = [{"circle": {"center": at, "radius": 0.2}} for at, first, last in people if first <= stamp <= last]
        now = World(obstacles=[*world.obstacles, *there], **SHELL)
        ranges.append(now.ray_distances(pose[None], ANGLES)[0])
    ranges = np.array(ranges) + SIGMA * rng.standard_normal((count, len(ANGLES)))
    return ReferenceDrive(stamps, poses, ranges, ANGLES, np.zeros(3), 20.0)


def beams(scans):
    return Beams.of(scans.poses, scans.mount, scans.angles, scans.ranges)


@pytest.fixture(scope="module")
def original():
    """A model of both rooms as they were, and the places that it knows."""
    scans = drive(BEFORE, (0.3, 0.3), (7.7, 3.7), 400, 1)
    model = FieldModel(learn_field(beams(scans), Recipe(0.05, sweeps=6, beams_per_sweep=200_000)))
    return model, scans.poses[:150, :2]


@pytest.fixture(scope="module")
def version(original):
    """A version from a drive in the west room, after the cupboard was moved."""
    model, places = original
    return learn_version(model, places, model, drive(AFTER, *WEST, 80), RECIPE)


def mean_of_predicted(model, scans):
    """Mean error in m, without the beams that the model does not predict."""
    errors = absolute_range_errors(model, scans)
    return mean_error(errors[np.isfinite(errors)])


def error(model, world, low, high):
    """Mean error in m of the ranges of noise-free scans between two corners."""
    scans = drive(world, low, high, 60, 9)
    exact = RayCaster(world).expect(scans.poses, ANGLES).ranges
    return mean_of_predicted(model, replace(scans, ranges=exact))


WEST, EAST = ((0.3, 0.3), (3.7, 3.7)), ((4.5, 0.3), (7.7, 3.7))


def test_moved_cupboard(original, version):
    """The field follows the cupboard in the west room, and stays as it was in the east room."""
    model, _ = original
    before, after = (error(each, AFTER, *WEST) for each in (model, version.model))
    assert before > 0.01
    assert after < 0.5 * before
    assert after < 1.3 * error(model, BEFORE, *WEST) + 0.001
    before, after = (error(each, AFTER, *EAST) for each in (model, version.model))
    assert after < before + 0.0015
    assert len(version.key_poses) == 80
    assert mean_error(version.errors) < mean_error(version.present_errors)
    west = drive(AFTER, *WEST, 1).poses
    assert np.hypot(*(version.seeds.places - west[0, :2]).T).min() < 0.4


def test_cupboard_moved_back(original, version):
    """The version in use has learned most held-out key scans, which therefore do not show that it is outdated."""
    first, again = drive(AFTER, *WEST, 80), drive(BEFORE, *WEST, 20, 7)
    keys = replace(
        first,
        stamps=np.concatenate([first.stamps, first.stamps[-1] + 1 + again.stamps]),
        poses=np.concatenate([first.poses, again.poses]),
        ranges=np.concatenate([first.ranges, again.ranges]),
    )
    until = float(first.stamps[-1])
    model, places = original
    back = learn_version(model, places, version.model, keys, RECIPE, learned_until=until)
    before, after = (error(each, BEFORE, *WEST) for each in (version.model, back.model))
    assert before > 0.01
    assert after < 0.3 * before


def test_no_new_key_scan_is_held_out(original, version):
    """Nothing shows whether a version is better if the model in use has learned all held-out key scans."""
    model, places = original
    keys = drive(AFTER, *WEST, 60)
    assert learn_version(model, places, model, keys, RECIPE, learned_until=float(keys.stamps[57])) is None
    assert version.test_scans == 80 // HELD_OUT_EVERY


def test_poses_of_a_rough_map(original):
    """Poses of a rough map are wrong by centimetres each; the field that they give together is not."""
    scans, others = (drive(BEFORE, (0.3, 0.3), (7.7, 3.7), 120, seed) for seed in (0, 5))
    off = np.random.default_rng(3).normal(0, 1, (2, 120, 3)) * (0.02, 0.02, 0.005)
    rough = RayCaster(grid_of("rough", replace(others, poses=others.poses + off[0])))
    version = learn_version(rough, original[1], rough, replace(scans, poses=scans.poses + off[1]), RECIPE)
    assert error(version.model, BEFORE, *WEST) < 0.003
    assert np.abs(version.key_poses - scans.poses)[:, :2].mean() < 0.2 * np.abs(off[1, :, :2]).mean()


def test_rooms_of_a_grid_that_were_not_entered(original):
    """There, surfaces stay in the middle of the occupied cells, where the estimator expects them in a grid."""

    def in_grid(scans):
        return replace(scans, poses=scans.poses + np.array([0.02, 0.03, 0]))  # no surface along the edges of cells

    rough = RayCaster(grid_of("rough", in_grid(drive(BEFORE, (0.3, 0.3), (7.7, 3.7), 300, 5))))
    version = learn_version(rough, original[1], rough, in_grid(drive(BEFORE, *WEST, 80)), RECIPE)
    scans = drive(BEFORE, *EAST, 60, 9)
    exact = replace(in_grid(scans), ranges=RayCaster(BEFORE).expect(scans.poses, ANGLES).ranges)
    before, after = (mean_of_predicted(model, exact) for model in (rough, version.model))
    assert after < 0.45 * before


def test_frame_of_the_original_model(original):
    """Key scans that are consistent, but all off by the same, are moved back."""
    scans = drive(BEFORE, (0.3, 0.3), (7.7, 3.7), 60)
    moved = se2.compose(np.array([0.03, -0.02, 0.01]), scans.poses)
    off = align_to_map(original[0], replace(scans, poses=moved)).poses - scans.poses
    assert np.abs(off[:, :2]).max() < 0.003
    assert np.abs(se2.wrap(off[:, 2])).max() < 0.001


def test_unchanged_surroundings(original):
    """The model in use is kept if a model learned from the scans predicts them no better."""
    _, places = original
    exact = RayCaster(BEFORE)
    assert learn_version(exact, places, exact, drive(BEFORE, *WEST, 60), RECIPE) is None


def test_room_that_the_model_lacks(original):
    """It is learned, even if nothing else is to be improved."""

    class WestRoom(RayCaster):
        def expect(self, lasers, angles):
            expected = super().expect(lasers, angles)
            ends = lasers[:, :1] + expected.ranges * np.cos(lasers[:, 2:] + angles)
            return replace(expected, scale=np.where(ends > 4.15, np.inf, expected.scale))

    _, places = original
    west = WestRoom(BEFORE)
    version = learn_version(west, places[places[:, 0] < 4], west, drive(BEFORE, (0.3, 0.3), (7.7, 3.7), 120), RECIPE)
    assert error(version.model, BEFORE, *EAST) < 0.005


def test_people_leave_no_trace(original, version):
    model, places = original
    # Every 8 s a person walks through the room, 0.8 m between two scans.
    people = [((0.4 + 0.8 * (k % 10), 0.6 + 0.04 * k), 0.8 * k - 0.1, 0.8 * k + 0.1) for k in range(80) if k % 10 < 5]
    scans, empty = drive(AFTER, *WEST, 80, people=people), drive(AFTER, *WEST, 80)
    hit = scans.ranges < empty.ranges - 0.1
    assert hit.mean() > 0.02
    kept = remove_moving_objects(scans)
    assert np.isfinite(kept.ranges[~hit]).mean() > 0.98
    with_people = learn_version(model, places, model, scans, RECIPE).model
    assert error(with_people, AFTER, *WEST) < error(version.model, AFTER, *WEST) + 0.002


def test_person_standing_still_for_a_scan():
    scans = drive(AFTER, *WEST, 30, people=[((1.5, 1.8), 7.9, 9.7)])
    hit = scans.ranges < drive(AFTER, *WEST, 30).ranges - 0.1
    kept = remove_moving_objects(scans)
    assert np.isneginf(kept.ranges[hit]).mean() > 0.8


def test_encoded_field(version):
    data = weights.encode(version.model, version.seeds.places)
    decoded, seeds = weights.decode(data)
    assert np.array_equal(decoded.field.phi, version.model.field.phi)
    assert np.array_equal(decoded.scales, version.model.scales)
    assert np.array_equal(decoded.seen.cells, version.model.seen.cells)
    grid = (version.model.field.origin, version.model.field.resolution)
    assert (decoded.field.origin, decoded.field.resolution) == grid
    tensors = weights.safetensors.numpy.load(weights.zlib.decompress(data))
    tensors["grid"] = np.append(tensors["grid"], 0.01)  # older fields state the error of their normals
    older, _ = weights.decode(weights.zlib.compress(weights.safetensors.numpy.save(tensors)))
    assert (older.field.origin, older.field.resolution) == grid
    assert np.array_equal(seeds.panoramas, version.seeds.panoramas)
    for damaged in (b"", data[:-100], data[100:], weights.zlib.compress(b"no arrays")):
        with pytest.raises(ValueError, match=r"field|array"):
            weights.decode(damaged)
