"""The navigation experiment: shortest paths, minimum times, measurements, and a small run."""

from __future__ import annotations

import json
import signal
from dataclasses import replace

import numpy as np
import psutil
import pytest
import shapely
import shapely.affinity
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from common.bus.bus import wait_until
from common.errors import UserError
from common.geometry.world import Box, Obstacle, World, load_world, save_world
from common.messages.definitions import Belief, Health, Pose, Status, Truth, Twist
from common.robot.robot import Robot
from lab.experiments.lockstep import LockstepRun, RunTrace, _append, _is_final
from lab.experiments.start_and_goal import StartAndGoal
from lab.experiments.trials import TrialStore
from lab.navigation import docking
from lab.navigation import drive as driven
from lab.navigation import experiment as driving
from lab.navigation import shortest_path as shortest
from lab.navigation.shortest_path import NavigationTask, ShortestPaths, draw_task, length, load_shortest_paths
from lab.navigation.worlds import RULES, StartGoalRule, seed_of, world_of
from lab.pages import tables_page as page
from tests.conftest import WAIT_TIMEOUT_S, ended

QUIET = Console(quiet=True)
ROBOT, TURNING = Robot(), Robot(drive="differential")
HALL = World(name="hall", boundary=[(0, 0), (10, 0), (10, 6), (0, 6)])


def block(*boxes, boundary=HALL.boundary, name="block"):
    obstacles = [Obstacle(box=Box(center=(x, y), size=(w, h))) for x, y, w, h in boxes]
    return World(name=name, boundary=boundary, obstacles=obstacles)


def test_straight_path():
    path = ShortestPaths(HALL, 0.3).path(np.array([1.0, 1.0]), np.array([9.0, 5.0]))
    assert path.tolist() == [[1.0, 1.0], [9.0, 5.0]]


def test_path_around_a_box():
    """A box from (4, 0) to (6, 3), with start and goal at the height of its top."""
    r = 0.4
    paths = ShortestPaths(block((5.0, 1.5, 2.0, 3.0)), r)
    start, goal = np.array([1.0, 3.0]), np.array([9.0, 3.0])
    tangent = np.sqrt(3.0**2 - r**2)
    turned = np.arcsin(r / 3.0)
    expected = 2 * tangent + 2 * turned * r + 2.0
    assert length(paths.path(start, goal)) == pytest.approx(expected, abs=2e-3)


def test_shorter_way():
    paths = ShortestPaths(block((5.0, 2.5, 0.2, 3.0)), 0.3)  # from 1 to 4 of 6
    assert paths.path(np.array([2.0, 2.0]), np.array([8.0, 2.0]))[1:-1, 1].max() < 1.01
    assert paths.path(np.array([2.0, 3.0]), np.array([8.0, 3.0]))[1:-1, 1].min() > 3.99


def test_narrow_door():
    start, goal = np.array([1.0, 3.0]), np.array([9.0, 3.0])
    wall = block((5.0, 1.2, 0.2, 2.4), (5.0, 4.5, 0.2, 3.0))  # 0.6 m between
    assert len(ShortestPaths(wall, 0.29).path(start, goal)) >= 3
    assert ShortestPaths(wall, 0.31).path(start, goal).shape == (0, 2)


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_clearance_and_no_shortcut(seed):
    world, paths = load_shortest_paths("maze")
    rng = np.random.default_rng(seed)
    start, middle, goal = world.sample_free(3, rng, ROBOT.radius + shortest.START_GOAL_MARGIN)
    path = paths.path(start, goal)
    keeps = shapely.distance(shapely.LineString(path), shapely.boundary(world.free_space))
    assert keeps >= ROBOT.radius + shortest.WALL_GAP - shortest.ARC_TOLERANCE - 1e-5
    assert length(path) >= np.hypot(*(goal - start)) - 1e-9
    assert length(path) == pytest.approx(length(paths.path(goal, start)))
    assert length(path) <= length(paths.path(start, middle)) + length(paths.path(middle, goal)) + 1e-9
    # Leaving out a corner gains nothing.
    for k in range(1, len(path) - 1):
        direct = shapely.LineString(path[[k - 1, k + 1]])
        if shapely.covers(paths.room, direct):
            assert direct.length == pytest.approx(length(path[k - 1 : k + 2]), abs=1e-6)


@pytest.mark.parametrize("world", ["maze", "office", "twins"])
def test_valid_trips(world):
    known, _ = load_shortest_paths(world)
    tasks = [draw_task(world, np.random.default_rng((1, k)), ROBOT) for k in range(25)]
    for k, task in enumerate(tasks):
        assert task == draw_task(world, np.random.default_rng((1, k)), TURNING)
        ends = [task.start[:2], task.goal]
        assert known.clearance(ends).min() >= ROBOT.radius + shortest.START_GOAL_MARGIN - 1e-3
        assert length(np.array(task.shortest)) >= StartGoalRule().min_length - 1e-3
        assert task.shortest[0] == task.start[:2]
        assert task.shortest[-1] == task.goal
    assert len({task.start for task in tasks}) == 25
    assert np.ptp([task.start[2] for task in tasks]) > 4  # any heading


def test_world_too_small(tmp_path):
    cell = tmp_path / "cell.yaml"
    cell.write_text(save_world(World(name="cell", boundary=[(0, 0), (1.5, 0), (1.5, 1.5), (0, 1.5)])))
    with pytest.raises(UserError, match="no two places 2 m apart"):
        draw_task(str(cell), np.random.default_rng(0), ROBOT)


def truth(number, x, speed=0.0, **more):
    return Truth(stamp_ns=number * 100_000_000, pose=Pose(x=x, y=1.0), twist=Twist(vx=speed), **more)


def belief(number, x, state="tracking"):
    return Belief(
        stamp_ns=number * 100_000_000, state=state, pose=Pose(x=x, y=1.0), xi=np.zeros(3), free_energy=0.0, accuracy=0.0
    )


def status(number, state, reason="", goal_seq=1, *, refused=False):
    return Status(stamp_ns=number * 100_000_000, state=state, reason=reason, goal_seq=goal_seq, refused=refused)


TASK = NavigationTask((1.0, 1.0, 0.0), (5.0, 1.0), ((1.0, 1.0), (5.0, 1.0)))


def a_trace(last="reached", ends_at=4.99):
    people = np.array([[3.0, 2.0], [9.0, 5.0]], np.float32)
    truths = [
        truth(0, 1.0),
        truth(1, 2.0, 0.5, people=people, stopped=True),
        truth(2, 3.0, 0.0, contact=True, people=people),  # standing, after driving into an obstacle
        truth(3, 3.0, contact=True),
        truth(4, ends_at, 0.4),
    ]
    beliefs = [belief(0, 8.0, "ambiguous"), belief(1, 2.01), belief(2, 3.0), belief(3, 3.02), belief(4, ends_at)]
    states = [
        status(0, "exploring", "2 places are possible"),
        status(1, "navigating"),
        status(2, "blocked", "waiting: something that moves, 0.8 m away at (1.0, -3.4)"),
        status(3, "blocked", "waiting: something that moves, 0.7 m away at (1.0, -3.4)"),
        status(4, last),
    ]
    health = Health(
        stamp_ns=9, service="controller", uptime=1.0, counters={"steps": 4, "step_us": 8000, "step_us_max": 5000}
    )
    return RunTrace(truths, beliefs, {each.stamp_ns: each for each in states}, [0, 0, 3], health)


def test_measurements_of_a_drive():
    found = driven.measure(a_trace(), TASK, HALL, ROBOT)
    assert found["outcome"] == "reached"
    assert found["driven_m"] == pytest.approx(3.99)
    assert found["path_over_shortest"] == pytest.approx(1.0)  # stopping short saves nothing
    assert found["time_over_bound"] == pytest.approx(0.4 / (4.0 - 0.02 + 1.0))
    assert (found["contacts_moving"], found["contacts_standing"]) == (1, 1)
    first = {"s": 0.2, "x": 3.0, "y": 1.0, "yaw": 0.0, "speed": 0.0, "person": [3.0, 2.0]}
    assert found["contact_at"][0] == first
    assert found["contact_at"][1]["person"] is None
    assert found["held_back"] == 1
    assert found["clearance_m"] == pytest.approx(1.0 - ROBOT.radius)
    assert found["clearance_to_people_m"] == pytest.approx(1.0 - ROBOT.radius - 0.25)
    assert found["tracking_s"] == pytest.approx(0.1)
    assert found["error_max_m"] == pytest.approx(0.02)
    assert found["error_median_m"] == pytest.approx(0.005)
    assert found["untracked_s"] == 0
    assert found["replans"] == 1
    assert found["state_s"] == {"exploring": 0.1, "navigating": 0.1, "blocked": 0.2}
    assert found["reason_s"]["blocked: waiting: something that moves"] == 0.2
    assert (found["step_mean_ms"], found["step_max_ms"]) == (2.0, 5.0)
    assert len(found["events"]) == 4  # a different distance is not a new reason


def test_errors_by_state():
    trace = a_trace()
    trace.beliefs[3] = belief(3, 7.0, "localising")
    found = driven.measure(trace, TASK, HALL, ROBOT)
    assert found["longest_untracked_s"] == pytest.approx(0.2)  # from 0.2 to 0.4 s
    assert found["error_max_m"] == pytest.approx(4.0)
    assert found["claimed_error_max_m"] == pytest.approx(0.01)
    assert found["untracked_s"] == pytest.approx(0.3 / 4)  # of four scans since 0.1 s one
    never = driven.measure(RunTrace(trace.truths, [belief(k, 9.0, "lost") for k in range(5)]), TASK, HALL, ROBOT)
    assert never["tracking_s"] is never["error_max_m"] is None
    assert never["longest_untracked_s"] == pytest.approx(0.4)  # the whole drive


def test_reasons_without_places():
    for place in ("", ", 0.8 m away at (1.2, -3.4)", " at (-1.0, 2.0)"):
        assert (
            driven.strip_numbers(f"waiting: something{place}: until it clears") == "waiting: something: until it clears"
        )
    assert driven.strip_numbers("2 places are possible: going to (1.0, 2.0) to tell them apart") == (
        "2 places are possible: going to tell them apart"
    )


def test_clearance_between_scans():
    world = block((5.0, 3.0, 0.2, 0.2))
    path = np.array([[4.0, 3.5, 0.0], [6.0, 3.5, 0.0]])  # no scan was taken beside the box
    assert driven._clearance(world, path).min() == pytest.approx(0.4)


def test_outcomes():
    far = driven.measure(a_trace(ends_at=4.97), TASK, HALL, ROBOT)
    assert far["outcome"] == "claimed elsewhere"
    assert not far["reached"]
    late = driven.measure(a_trace("blocked"), TASK, HALL, ROBOT)
    assert late["outcome"] == "too late"
    assert "0.01 m from the goal after 0.4 s; at last blocked" in late["why"]
    trace = a_trace("blocked")
    trace.failure = "controller ended with status 1: x"
    broken = driven.measure(trace, TASK, HALL, ROBOT)
    assert (broken["outcome"], broken["why"]) == ("failed", trace.failure)
    trace = a_trace()
    why = "goal refused: (5.00, 1.00) in hall is inside something, or off the map"
    trace.statuses[400_000_000] = status(4, "blocked", why, refused=True)
    assert driven.measure(trace, TASK, HALL, ROBOT)["outcome"] == "refused"
    trace.health = None
    assert driven.measure(trace, TASK, HALL, ROBOT)["step_mean_ms"] is None


def test_worst_trials():
    rows = []
    for number, trace in enumerate([a_trace(), a_trace(ends_at=4.0), a_trace()]):
        rows.append({"trial": number, **driven.measure(trace, TASK, HALL, ROBOT)})
    rows[2] |= {"contacts_moving": 0, "contacts_standing": 0, "contact_at": [], "time_over_bound": 3.0}
    summary = driving.summarise(rows)
    assert (summary["trials"], summary["reached"], summary["trials_claimed_elsewhere"]) == (3, 2, 1)
    assert summary["trials_with_contact_moving"] == 2
    assert summary["max_time_over_bound"] == 3.0
    assert summary["min_clearance_to_people_m"] == pytest.approx(0.48)
    assert [each["trial"] for each in summary["worst"]] == [1, 0, 2]
    assert "touched something in 2 scans, first at 0.2 s" in summary["worst"][1]["why"]
    table = driving.table({"hall, holonomic": summary})
    assert "| hall, holonomic | 2/3 (21 to 94 %) | 1 | 2; 2 |" in table
    assert "trial 1, claimed elsewhere: 1.00 m from the goal" in table
    assert "trial 0, reached: touched something" in table
    assert "trial 2" not in table
    none = driving.summarise([rows[1]])
    assert none["median_time_over_bound"] is None
    assert "–" in driving.table({"x": none})


def test_end_of_a_drive():
    lockstep_run = LockstepRun(
        StartAndGoal((1.0, 1.0), (5.0, 1.0)), 0.0, "maze", 101, 0, (), 100, ends_with_status=True
    )
    trace, end = RunTrace(), None
    # A possible order: another process's messages about the next scan arrive before this scan's status.
    order = [truth(0, 1.0), status(0, "navigating"), belief(0, 1.0), truth(1, 5.0), belief(1, 5.0), truth(2, 5.0),
             status(1, "reached"), belief(2, 5.0), status(2, "reached")]  # fmt: skip
    for message in order:
        assert not trace.has(200_000_000)  # without the status of the last scan, too
        _append(message, trace, end)
        if end is None and _is_final(message, trace, lockstep_run):
            end = message.stamp_ns
    assert end == 100_000_000
    assert trace.has(200_000_000)
    trace.discard_after(end)
    assert len(trace.truths) == len(trace.beliefs) == len(trace.statuses) == 2
    assert not _is_final(truth(1, 5.0), RunTrace(), lockstep_run)  # being there is not enough
    assert _is_final(truth(1, 5.0), RunTrace(), replace(lockstep_run, ends_with_status=False))
    assert _is_final(status(0, "blocked", "goal refused: no", refused=True), RunTrace(), lockstep_run)
    assert not _is_final(status(0, "reached", goal_seq=0), RunTrace(), lockstep_run)


def test_result_names():
    job = driving.NavigationJob(0, 1)
    assert driving.result_name(job, driving.WORLDS, driving.DRIVES) == "navigation"
    assert driving.result_name(replace(job, seed=7, limit=9.0), driving.WORLDS, driving.DRIVES) == "navigation"
    odd = replace(job, start="unknown", people=10, epistemic=False, estimator="particle-filter", prior="odometry")
    name = driving.result_name(odd, ("folder/my.yaml",), ("differential",))
    assert name == "navigation-my-differential-unknown-people10-particle-filter-odometry-no-epistemic"


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("--worlds", "moon"), "no world 'moon'"),
        (("--worlds", ""), "--worlds ''"),
        (("--drives", "legs"), "--drives 'legs': choose from holonomic, differential"),
        (("--drives", "holonomic,holonomic"), "each only once"),
        (("--start", "maybe"), "--start 'maybe': choose from known, unknown"),
        (("--estimator", "paper"), "--estimator 'paper': choose from precise, particle-filter"),
    ],
)
def test_invalid_options(args, says):
    from typer.testing import CliRunner

    from lab.cli import experiment as cli_experiment

    result = CliRunner().invoke(cli_experiment.app, ["navigation", *args])
    assert isinstance(result.exception, UserError)
    assert says in str(result.exception)
    assert "\n" not in str(result.exception)


def test_small_run(tmp_path):
    job = driving.NavigationJob(0, 1, beams=101, limit=30.0)
    result = driving.run(job, 1, tmp_path, 1, QUIET, worlds=("maze",))
    assert {path.name for path in tmp_path.iterdir()} == {
        f"navigation-maze-beams101{suffix}" for suffix in (".json", ".csv", ".trials.jsonl", ".pdf", ".png")
    }
    written = json.loads((tmp_path / "navigation-maze-beams101.json").read_text())
    assert written["parameters"]["beams"] == 101
    assert {"seed", "commit", "command", "versions"} <= set(written)
    for drive in driving.DRIVES:
        summary = result.summary[f"maze, {drive}"]
        assert summary["reached"] == 1, summary["worst"]
        assert summary["trials_with_contact_moving"] == summary["trials_with_contact_standing"] == 0
        assert 0.98 < summary["median_path_over_shortest"] < 1.5
        assert 0.9 < summary["median_time_over_bound"] < 2.0
        assert summary["max_error_max_m"] < 0.1
    holonomic, differential = result.trials
    assert holonomic["goal"] == differential["goal"]
    assert holonomic["x_m"] != differential["x_m"]
    text = page.fill_tables("<!-- table navigation-maze-beams101 -->\n<!-- end -->", tmp_path)
    assert "| maze, differential | 1/1 (21 to 100 %) | 0 | 1." in text


def test_interrupted_and_killed_runs(process, tmp_path):
    """After Ctrl-C the same command continues; a killed one leaves neither workers nor services."""
    args = ("presage.__main__", "experiment", "--out", str(tmp_path), "docking", "--trials", "5")
    jobs = [
        docking.DockingJob(index, 1, drive=drive, world=driving.WORLDS[index // 2 % 2])
        for index in range(5)
        for drive in driving.DRIVES
    ]
    TrialStore(tmp_path / ".docking.unfinished.jsonl", jobs).add(0, {})

    def start(workers):
        """The run and its child processes, once it drives."""
        run = process(*args, env={"PRESAGE_WORKERS": str(workers)})
        run.wait_for("continuing after 1 of 10", 90)

        def children():
            return psutil.Process(run.child.pid).children(recursive=True)

        assert wait_until(lambda: any("services" in " ".join(c.cmdline()) for c in children()), WAIT_TIMEOUT_S)
        return run, children()

    run, children = start(1)
    run.send(signal.SIGINT)
    # Python ignores an interrupt while it forks, so send it again if necessary.
    wait_until(lambda: not run.running, 5)
    if run.running and "are kept" not in run.output:
        run.send(signal.SIGINT)
    assert run.wait(30) == 130, run.output
    assert "1 of 10 trials are kept" in run.output
    assert wait_until(lambda: all(map(ended, children)), 20)
    run, children = start(2)
    run.kill()
    assert wait_until(lambda: all(map(ended, children)), 20)


def test_rooms_of_trips():
    rooms = RULES["twins"].rooms
    free = load_world("twins").free_space
    assert all(shapely.intersection(free, shapely.box(*room)).area > 10 for room in rooms)
    rng = np.random.default_rng(0)
    for _ in range(20):
        task = shortest.draw_task("twins", rng, Robot())
        places = shapely.points([task.start[:2], task.goal])
        assert all(any(shapely.box(*room).covers(place) for room in rooms) for place in places)


def test_generated_worlds():
    """Five trials in each; in a hall they are long, and begin and end near a wall."""
    jobs = [driving.NavigationJob(k, 7, world="hall") for k in range(6)]
    assert len({job.world_seed for job in jobs[:5]}) == 1
    assert jobs[5].world_seed != jobs[0].world_seed
    for job in jobs[::5]:
        hall, task = world_of("hall", job.world_seed), job.task()
        assert hall.clearance([task.start[:2], task.goal]).max() <= 2.0
        assert length(np.array(task.shortest)) >= 10 - 1e-3
        assert shapely.area(shapely.buffer(hall.free_space, -4.0)) > 20  # out of sight with a range of 4 m
    for seed in (5_000_000, 5_000_001):  # the second one's first building is the same after a half turn
        x, y = world_of("look-alike", seed).center()
        turned = shapely.affinity.rotate(world_of("look-alike", seed).free_space, 180, origin=(x, y))
        assert shapely.symmetric_difference(world_of("look-alike", seed).free_space, turned).area > 0.05
    assert seed_of("maze", 7, 3) == 0
