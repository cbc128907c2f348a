"""Localisation in buildings: the floor of a belief, kidnapping to another floor, and floors that look alike."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import World, save_world
from common.messages.definitions import Belief, Goal, Pose, Scan
from common.messages.requests import LocaliseRequest
from common.messages.topics import GOAL, LOCALISE, SCAN
from common.robot.scanner import SCANNERS
from services.estimator.service import EstimatorService, SharedModels
from services.estimator.settings import EstimatorSettings
from tests.common.geometry.maps import ROOM

SCANNER = SCANNERS["tim571"].with_beams(135)
ATTIC = World(
    name="attic",
    boundary=[(0, 0), (7, 0), (7, 3), (3, 4.5), (0, 4.5)],
    obstacles=[{"box": {"center": (4, 1), "size": (0.8, 0.4), "yaw_deg": -20}}],
)
HERE, UPSTAIRS = np.array([4.5, 3.2, 0.4]), np.array([5.0, 2.2, -2.0])


class StoringService(EstimatorService):
    """Stores beliefs instead of publishing messages."""

    def __init__(self, settings, models):
        super().__init__(settings, models)
        self.beliefs = []
        self.rng = np.random.default_rng(0)

    def publish(self, topic, message):
        if isinstance(message, Belief):
            self.beliefs.append(message)

    def scan(self, floor, pose):
        """Measures a noisy scan on a floor, and returns the belief."""
        assert self.models is not None
        laser = se2.compose(self.models.world.to_map(pose, floor), SCANNER.mount)
        ranges = SCANNER.add_noise(self.models.world.ray_distances(laser[None], SCANNER.angles())[0], self.rng)
        values = {
            "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment, "range_min": 0.05,
            "range_max": 25.0, "ranges": ranges.astype(np.float32), "mount": Pose.of(SCANNER.mount),
        }  # fmt: skip
        self.on_message(SCAN, Scan(stamp_ns=len(self.beliefs) * 66_666_667, sigma=SCANNER.sigma, **values))
        return self.beliefs[-1]

    def on_floor(self, belief):
        return self.models.world.floor(belief.map_id).from_map(belief.pose.array())


def models_of(folder, **floors):
    for name, world in floors.items():
        (folder / f"{name}.yaml").write_text(save_world(world))
    lines = "".join(f"  {name}: {name}.yaml\n" for name in floors)
    (folder / "tower.yaml").write_text(f"name: tower\nfloors:\n{lines}")
    return SharedModels(EstimatorSettings(world=str(folder / "tower.yaml"), model="exact"))


@pytest.fixture(scope="module")
def different(tmp_path_factory):
    return models_of(tmp_path_factory.mktemp("different"), ground=ROOM, attic=ATTIC)


@pytest.fixture
def service(different):
    return StoringService(EstimatorSettings(), different)


@pytest.mark.parametrize(("floor", "pose"), [("ground", HERE), ("attic", UPSTAIRS)])
def test_floor_from_a_single_scan(service, floor, pose):
    belief = service.scan(floor, pose)
    assert (belief.state, belief.map_id) == ("tracking", floor)
    np.testing.assert_allclose(service.on_floor(belief), pose, atol=0.03)


def test_kidnapped_to_another_floor(service):
    for _ in range(5):
        assert service.scan("ground", HERE).map_id == "ground"
    beliefs = [service.scan("attic", UPSTAIRS) for _ in range(20)]
    assert all(belief.map_id == "attic" for belief in beliefs if belief.state == "tracking")
    assert (beliefs[-1].state, beliefs[-1].map_id) == ("tracking", "attic")
    np.testing.assert_allclose(service.on_floor(beliefs[-1]), UPSTAIRS, atol=0.03)


def test_identical_floors(tmp_path):
    service = StoringService(EstimatorSettings(), models_of(tmp_path, ground=ROOM, first=ROOM))
    beliefs = [service.scan("first", HERE + 0.02 * k) for k in range(30)]
    assert {belief.state for belief in beliefs} == {"ambiguous"}
    floors = [service.models.world.floor_at(each.pose.array()) for each in beliefs[-1].hypotheses]
    assert {floor.name for floor in floors} == {"ground", "first"}


def test_localise_on_a_floor(service):
    service.scan("ground", HERE)
    service.on_request(LOCALISE, LocaliseRequest(pose=Pose.of(UPSTAIRS), map_id="attic"))
    belief = service.scan("attic", UPSTAIRS)
    assert (belief.state, belief.map_id) == ("tracking", "attic")
    with pytest.raises(UserError, match="no floor 'cellar': choose one of ground, attic"):
        service.on_request(LOCALISE, LocaliseRequest(pose=Pose.of(UPSTAIRS), map_id="cellar"))


def test_goal_on_a_floor(service):
    service.on_message(GOAL, Goal(stamp_ns=0, pose=Pose.of(UPSTAIRS), map_id="attic"))
    np.testing.assert_allclose(service.goal, service.models.world.to_map(UPSTAIRS, "attic"))
    service.on_message(GOAL, Goal(stamp_ns=0, pose=Pose.of(UPSTAIRS), map_id="cellar"))
    assert service.goal is None


def test_world_without_floors():
    service = StoringService(EstimatorSettings(), SharedModels(EstimatorSettings()))
    assert service.scan("", [5.0, 1.5, 2.0]).map_id == ""
