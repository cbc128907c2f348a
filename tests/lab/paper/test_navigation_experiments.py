"""E3 and the step sizes: journeys, minimum times, small runs with real processes, and the paper's literal algorithm."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from common.errors import UserError
from common.geometry.world import World, load_world
from common.messages.definitions import Belief, Pose, Truth, Twist
from common.robot.robot import Robot
from lab.experiments.estimators import ExperimentWorld
from lab.experiments.lockstep import RunTrace, _is_next
from lab.experiments.start_and_goal import (
    ARRIVAL_DISTANCE,
    CLEARANCE,
    StartAndGoal,
    draw_start_and_goal,
    least_time,
    path_ratio,
)
from lab.paper import e3_navigation as navigation
from lab.paper import step_sizes as stepping
from lab.paper import teleports
from services.estimator.paper.decoder import Normalisation

QUIET = Console(quiet=True)
ROBOT = Robot()
CORRIDOR = load_world("corridor")


@given(st.integers(0, 10_000), st.floats(2.0, 14.0))
@settings(max_examples=30)
def test_valid_starts_and_goals(seed, apart):
    ends = draw_start_and_goal(CORRIDOR, np.random.default_rng(seed), ROBOT, apart)
    assert ends.straight >= apart
    along = np.linspace(ends.start, ends.goal, 200)
    assert CORRIDOR.clearance(along).min() >= ROBOT.radius + CLEARANCE - 1e-3  # between places, to a millimetre
    assert ends == draw_start_and_goal(CORRIDOR, np.random.default_rng(seed), ROBOT, apart)
    assert [float(repr(v)) for v in ends.start] == [round(v, 3) for v in ends.start]


def test_rejected_pairs():
    drawn = [draw_start_and_goal(CORRIDOR, np.random.default_rng(k), ROBOT) for k in range(60)]
    assert sum(each.obstructed for each in drawn) > 5
    assert sum(each.too_near for each in drawn) > sum(each.obstructed for each in drawn)
    assert len({each.start for each in drawn}) == 60


def test_world_without_a_start_and_goal():
    with pytest.raises(UserError, match=r"no two places 12 m apart"):
        draw_start_and_goal(
            World(name="cell", boundary=[(0, 0), (3, 0), (3, 3), (0, 3)]), np.random.default_rng(0), ROBOT
        )


def test_least_time():
    robot = Robot(max_speed=1.0, acceleration=1.0)
    assert least_time(12.8, robot) == pytest.approx(12.5)
    assert least_time(0.8 + 0.125, robot) == pytest.approx(0.5)  # never at full speed
    assert least_time(0.5, robot) == 0.0
    assert least_time(12.8, robot, stop=True) == pytest.approx(13.0)
    assert least_time(0.8 + 0.25, robot, stop=True) == pytest.approx(1.0)


@given(st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=2, max_size=20))
def test_path_ratio(points):
    path = np.array(points)
    assert path_ratio(path) >= 1 - 1e-9
    if np.hypot(*(path[-1] - path[0])) > 1e-3:
        detour = np.concatenate([path[:1], path[:1] + 10.0, path])
        assert path_ratio(detour) > path_ratio(path)


def truth(number, x, **more):
    return Truth(stamp_ns=number * 100, pose=Pose(x=x, y=1.0), twist=Twist(), **more)


def belief(number, x):
    return Belief(
        stamp_ns=number * 100, state="tracking", pose=Pose(x=x, y=1.0), xi=np.zeros(3), free_energy=0.0, accuracy=0.0
    )


def test_measurements_of_a_journey():
    trace = RunTrace([truth(0, 1.0), truth(1, 2.0, contact=True), truth(2, 14.3)], [belief(k, 2.0) for k in range(3)])
    found = navigation.measure(trace, StartAndGoal((1.0, 1.0), (15.0, 1.0)))
    assert found["reached"]
    assert found["iterations"] == 2
    assert found["contacts"] == 1
    assert found["distance_m"] == [14.0, 13.0, 0.7]
    assert found["error_m"] == [1.0, 0.0, 12.3]
    row = {"estimators": {"precise": found}}
    away = {"estimators": {"precise": {**found, "reached": False, "contacts": 0, "seconds": 99.0}}}
    summary = navigation.summarise([row, away], "precise")
    assert (summary["reached"], summary["trials"], summary["trials_with_contact"]) == (1, 2, 1)
    assert summary["seconds_median"] == pytest.approx(200e-9)  # of those that arrived
    assert navigation.summarise([away], "precise")["seconds_median"] is None


def test_missing_message():
    kept = [truth(0, 1.0), truth(1, 1.0)]
    assert _is_next(kept, truth(2, 1.0))
    assert not _is_next(kept, truth(1, 1.0))  # sent again
    with pytest.raises(UserError, match="missing"):
        _is_next(kept, truth(3, 1.0))
    with pytest.raises(UserError, match="missing"):
        _is_next([], truth(1, 1.0))


def test_estimator_without_a_service(tmp_path):
    job = navigation.PaperNavigationJob(0, 1, estimators=("particle-filter, heading known",))
    with pytest.raises(UserError, match="heading known"):
        navigation.run(job, 1, tmp_path, 1, QUIET)


def test_e3_through_real_processes(tmp_path):
    job = navigation.PaperNavigationJob(0, 7, apart=3.0, estimators=("precise",), field=ExperimentWorld(beams=101))
    result = navigation.run(job, 1, tmp_path, 1, QUIET)
    summary = result.summary["precise"]
    assert (summary["reached"], summary["trials_with_contact"]) == (1, 0)
    assert summary["time_over_least_max"] < 1.6
    assert 1 <= summary["path_over_straight_max"] < 1.02
    assert summary["error_max_m"] < 0.2
    assert {path.suffix for path in tmp_path.iterdir()} >= {".json", ".csv", ".pdf", ".png"}
    assert "| precise | 1/1 | 0 |" in navigation.table(result.summary)


class Linear:
    """A model whose scan is the position itself, repeated many times, so that results can be computed by hand."""

    beams = 50
    norm = Normalisation((0.0, 0.0), (9.0, 9.0), 1.0)

    def predict(self, pose):
        jacobian = np.zeros((2 * self.beams, 3))
        jacobian[: self.beams, 0] = jacobian[self.beams :, 1] = 1
        return jacobian @ pose, jacobian


def linear_travel(steps, start=(2.0, 2.0), goal=(15.0, 2.5), limit=200):
    model = Linear()
    room = World(name="hall", boundary=[(0, 0), (18, 0), (18, 5), (0, 5)])
    return teleports.travel(
        StartAndGoal(start, goal), steps, model, lambda pose: model.predict(pose)[0], room, 0.0, limit
    )


def test_iterations_of_the_paper():
    """The belief moves half way to the goal at once (beta 1), the robot part of the way to the belief.

    Each iteration reduces the distance to 80 %.
    """
    stiff = Linear.beams
    outcome = linear_travel(teleports.StepSizes(alpha=0.5 / stiff, beta=1.0, gamma=0.4 / stiff))
    ratios = outcome.distance[1:] / outcome.distance[:-1]
    assert ratios == pytest.approx(0.8)
    assert outcome.reached
    assert outcome.iterations == int(np.ceil(np.log(outcome.distance[0] / ARRIVAL_DISTANCE) / -np.log(0.8)))


def test_summed_action():
    stiff = Linear.beams
    steps = teleports.StepSizes(alpha=0.5 / stiff, beta=1.0, gamma=0.02 / stiff, form="sum")
    summed = linear_travel(steps)
    speed = -np.diff(summed.distance)
    assert summed.reached
    assert speed[-1] > 3 * speed[0]  # fastest where it should slow down


def test_printed_signs_diverge():
    stiff = Linear.beams
    steps = teleports.StepSizes(alpha=0.1 / stiff, beta=1.0, gamma=0.05 / stiff, form="printed")
    printed = linear_travel(steps, limit=8)
    assert printed.error[-1] > 2.0
    assert printed.error[-1] > printed.error[2]


@given(st.floats(0.4, 17.6), st.floats(0.4, 4.1), st.floats(-30, 30), st.floats(-30, 30))
@settings(max_examples=60)
def test_displacement_in_free_space(x, y, dx, dy):
    room = shapely.buffer(CORRIDOR.free_space, -ROBOT.radius)
    place, step = np.array([x, y]), np.array([dx, dy])
    if not shapely.covers(room, shapely.Point(place)):
        return
    end, cut = teleports.displace(room, place, step)
    assert shapely.distance(room, shapely.Point(end)) < 1e-6
    assert cut or end == pytest.approx(place + step)
    if cut:
        assert np.hypot(*(end - place)) < np.hypot(*step)


def test_small_step_sizes(tmp_path, monkeypatch):
    few = [
        stepping.Setting("displacement", teleports.StepSizes(stepping.ALPHA, 1.0, 5e-3)),
        stepping.Setting("displacement", teleports.StepSizes(stepping.ALPHA, 1.0, 1e-3)),
        stepping.Setting("velocity", teleports.StepSizes(beta=0.0, gamma=0.3)),
    ]
    monkeypatch.setattr(stepping, "settings", lambda: few)
    job = stepping.StepSizeJob(0, 1, limit=60, velocity_limit=40)
    result = stepping.run(job, 2, tmp_path, 1, QUIET)
    quick, slow, driven = (result.summary[each.name] for each in few)
    assert quick["reached"] == slow["reached"] == 2
    assert 8 < quick["iterations_mean"] < 20 < slow["iterations_mean"]
    assert driven["reached"] == 0  # not in 40 scans
    again = stepping.trial(stepping.StepSizeJob(1, 1, limit=60, setting=few[0]))
    assert again == result.trials[1]
    assert "nearest to the paper's 12.5" in result.notes[0]
