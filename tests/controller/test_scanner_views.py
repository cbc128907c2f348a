"""Scanners with a limited view, mounted backwards or upside down: driving direction and free space."""

from __future__ import annotations

import numpy as np
import pytest

from common.geometry import se2
from common.robot.robot import Robot
from common.robot.scan_geometry import ALL_ROUND, Sector, Sweep
from common.robot.scanner import SCANNERS
from services.controller.policies.free_space import FreeSpace
from services.controller.policies.motion_model import turn_to_lookahead
from services.controller.policies.motion_selection import FIELD_OF_VIEW_MARGIN_RAD, Surroundings, select_motion
from services.controller.policies.obstacles import TemporaryObstacles
from services.controller.policies.planner import BLIND_AHEAD, GeodesicPolicy
from tests.controller.driving import belief, box, drive, goal, room, scan

HALL, CHANGED = room(8, 6), room(8, 6, box(4.0, 1.5, 0.5, 0.5))
FREE = FreeSpace.of(HALL)
LMS = SCANNERS["lms200"].model_copy(update={"rate": 15.0})  # its real rate takes five times as long
BACKWARDS = LMS.model_copy(update={"mount": (-0.2, 0.0, np.pi)})
A1 = SCANNERS["rplidar-a1"]
TURNED = {
    "0 to 359 deg": A1.model_copy(update={"first": 0.0}),
    "upside down": A1.model_copy(update={"upside_down": True}),
    "half, upside down": LMS.model_copy(update={"upside_down": True}),
}


@pytest.mark.parametrize(
    ("scanner", "sector"),
    [
        (SCANNERS["tim571"], Sector(0.0, np.deg2rad(135))),
        (LMS, Sector(0.0, np.pi / 2)),
        (BACKWARDS, Sector(-np.pi, np.pi / 2)),
        (TURNED["0 to 359 deg"], ALL_ROUND),
        (TURNED["upside down"], ALL_ROUND),
        (LMS.model_copy(update={"first": 0.0}), Sector(np.pi / 2, np.pi / 2)),
        (LMS.model_copy(update={"first": 0.0, "upside_down": True}), Sector(-np.pi / 2, np.pi / 2)),
    ],
)
def test_sector_in_base_link(scanner, sector):
    found = Sweep.of(scan(0, [4.0, 3.0, 1.0], HALL, scanner)).sector(scanner.mount[2])
    assert found.half == pytest.approx(sector.half)
    assert np.cos(found.centre - sector.centre) == pytest.approx(1.0)


@pytest.mark.parametrize("half_deg", [30, 90, 135])
@pytest.mark.parametrize("centre", [0.0, np.pi, 1.0])
def test_actions_stay_within_the_view(centre, half_deg):
    view = Sector(centre, np.deg2rad(half_deg))
    no_points, no_walls = np.zeros((0, 2)), lambda places: np.full(places.shape[:-1], np.inf)
    surroundings = Surroundings(no_walls, no_points, np.zeros(0, bool), 0.0, 0.33, field_of_view=view)
    for bearing in np.arange(0, 2 * np.pi, 0.5):
        lookahead = 3 * np.array([np.cos(bearing), np.sin(bearing)])
        action = select_motion(np.zeros(3), lookahead, surroundings, Robot()).action
        if np.hypot(*action[:2]) > 0.02:
            off = abs(float(se2.wrap(np.arctan2(action[1], action[0]) - centre)))
            assert off <= max(view.half - FIELD_OF_VIEW_MARGIN_RAD, view.half / 3) + 1e-6
        else:
            turned = turn_to_lookahead(
                np.zeros(3), action, lookahead, Robot(), may_turn=True, forward=surroundings.forward
            )
            assert abs(turned[2]) > 0.1  # turns until the lookahead point is in view


@pytest.mark.parametrize("name", TURNED)
def test_removed_obstacle(name):
    scanner, pose, layer = TURNED[name], np.array([2.0, 1.5, 0.4]), TemporaryObstacles(FREE)
    layer.update(scan(0, pose, CHANGED, scanner), pose)
    assert len(layer.points()) >= 4
    assert np.abs(layer.points() - [3.75, 1.5]).max() < 0.4
    for number in range(2):
        layer.update(scan(10**9 + number, pose, HALL, scanner), pose)
    assert len(layer.points()) == 0


def wander(observed):
    """The decision of a robot that is lost, two seconds after it got lost."""
    policy, pose = GeodesicPolicy(Robot(), HALL), observed.mount.array()
    policy.set_goal(np.array([6.0, 3.0]))
    policy.observe(observed, belief(observed.stamp_ns, pose, "lost"))
    policy.decide_unlocalised(belief(0, pose, "lost"), np.zeros(3), np.zeros(3))
    decision = policy.decide_unlocalised(belief(2 * 10**9, pose, "lost"), np.zeros(3), np.zeros(3))
    assert decision.state == "exploring"
    return decision.action


@pytest.mark.parametrize("name", TURNED)
def test_wandering(name):
    """Unmeasured beams count neither as free nor as wall, unless no beam is measured."""
    whole, actions = scan(2 * 10**9, [1.0, 3.0, 0.0], HALL, TURNED[name]), []
    for unmeasured in (slice(0, 0), slice(0, None, 2), slice(None)):
        ranges = np.array(whole.ranges)
        ranges[unmeasured] = 0.0
        actions.append(wander(whole.model_copy(update={"ranges": ranges})))
    assert actions[0][0] > 0.1  # there is most room ahead
    assert abs(actions[0][1]) < actions[0][0]
    np.testing.assert_allclose(actions[1], actions[0], atol=0.05)
    assert not actions[2][:2].any()  # turns on the spot


@pytest.mark.parametrize("scanner", [LMS, BACKWARDS], ids=["forwards", "backwards"])
def test_half_a_view(scanner):
    """The goal lies behind, an unmapped box is in the way, and the simulator's obstacle stop is off."""
    start = (6.0, 1.5, scanner.mount[2])
    poses, statuses, contacts = drive(
        CHANGED, Robot(), start, goal(2.0, 1.5), 400, known=HALL, stop=False, scanner=scanner
    )
    assert (statuses[-1].state, contacts) == ("reached", 0), statuses[-1]
    assert np.hypot(*(poses[5] - poses[0])[:2]) < 0.02  # it turns first


def test_no_view_ahead():
    policy, pose = GeodesicPolicy(Robot(drive="differential"), HALL), np.array([4.0, 3.0, 0.0])
    policy.set_goal(np.array([6.0, 3.0]))
    policy.observe(scan(0, pose, HALL, BACKWARDS), belief(0, pose))
    decision = policy.decide(belief(0, pose), np.zeros(3), np.zeros(3))
    assert decision.reason == BLIND_AHEAD
    assert not decision.action[:2].any()
