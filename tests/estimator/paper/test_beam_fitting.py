"""Conversion of scans to a model's beams: exact where possible, interpolated, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.robot.scanner import SCANNERS, Scanner
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.paper.beam_fitting import fit
from services.estimator.shared.interface import Observation
from tests.estimator.models import ROOM

TIM571 = SCANNERS["tim571"].with_beams(271)
POSE = np.array([2.8, 1.6, 0.4])


def like_tim571(**changes) -> Scanner:
    return TIM571.model_copy(update=changes)


def seen(scanner):
    return ROOM.ray_distances(se2.compose(POSE, scanner.mount)[None], scanner.angles())[0]


def fitted(scanner, model=TIM571):
    return fit(model, scanner.angles(), np.array(scanner.mount), "train")


def test_same_beams():
    same = fitted(TIM571)
    assert same.same
    ranges = seen(TIM571)
    assert same.ranges(ranges) is ranges


@pytest.mark.parametrize(
    "scanner",
    [
        like_tim571(beams=541),
        like_tim571(upside_down=True),
        like_tim571(mount=(0.2, 0.0, 0.5), first=float(np.deg2rad(-135) - 0.5)),
        SCANNERS["rplidar-a1"].model_copy(update={"mount": (0.2, 0.0, np.pi)}),
        SCANNERS["rplidar-a1"].model_copy(update={"mount": (0.2, 0.0, 0.0), "first": 0.0, "upside_down": True}),
    ],
)
def test_other_beams(scanner):
    found = fitted(scanner)
    assert found.ranges(seen(scanner)) == pytest.approx(seen(TIM571), abs=1e-6)
    back = found.predicted(seen(TIM571), scanner.angles())[0]
    known = np.isfinite(back)
    assert np.count_nonzero(known) >= 270
    assert np.median(np.abs(back - seen(scanner))[known]) < 1e-3


def test_interpolation():
    """Also between the last beam and the first of a scanner that sees all round."""
    model = SCANNERS["rplidar-a1"]
    scanner = model.model_copy(update={"first": model.angle_min + 0.25 * model.angle_increment})
    ranges = np.arange(360.0)
    expected = ranges - 0.25
    expected[0] = 0.25 * 359
    assert fitted(scanner, model).ranges(ranges) == pytest.approx(expected)
    valid = ranges != 7
    assert np.flatnonzero(~fitted(scanner, model).valid_beams(valid)).tolist() == [7, 8]
    assert np.flatnonzero(~fitted(model, model).valid_beams(valid)).tolist() == [7]


@pytest.mark.parametrize(
    ("scanner", "reason"),
    [
        (SCANNERS["lms200"], "has no beams towards -135 deg in base_link"),
        (like_tim571(mount=(0.2, 0.0, 0.2)), "has no beams towards -135 deg"),
        (like_tim571(fov=7.0), "the scan's beams cover 401 deg, more than a full turn"),
        (like_tim571(beams=61), r"beams are 4.50 deg apart; these weights accept at most 4.00 deg"),
        (like_tim571(mount=(0.2, 0.1, 0.0)), r"mounted at \(0.2, 0.1\) m, but the weights are for \(0.2, 0\) m"),
    ],
)
def test_unfit_scanner(scanner, reason):
    with pytest.raises(UserError, match=f"trained for tim571 with 271 beams: .*{reason}.*; train for it: train"):
        fitted(scanner)


def test_shipped_weights():
    scanner = SCANNERS["rplidar-a1"].model_copy(update={"mount": SCANNERS["tim571"].mount, "sigma_relative": 0.0})
    made = prepare_factory(EstimatorOptions("corridor", "paper"))(ScannerGeometry.of(scanner))
    world, pose = made.card.world, np.array([9.0, 1.5, made.card.heading])
    ranges = world.ray_distances(se2.compose(pose, scanner.mount)[None], scanner.angles())[0]
    made.restart(pose)
    for _ in range(10):
        posterior = made.update(Observation(scanner.limit(ranges), scanner.angles(), scanner.range_max))
    assert np.hypot(*(posterior.pose - pose)[:2]) < 0.3  # the decoder's own error is some decimetres
    blind = np.abs(scanner.angles()) > np.deg2rad(136)
    assert np.isposinf(posterior.predicted[blind]).all()
    assert np.isfinite(posterior.predicted[np.abs(scanner.angles()) < np.deg2rad(134)]).all()
    both = made.predict(pose[None], scanner.angles()[::10])
    assert both.ranges.shape == (1, 36)
