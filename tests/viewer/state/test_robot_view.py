"""Content of frames, when they are sent, and their binary layout."""

from __future__ import annotations

import json
import struct
from random import Random

import numpy as np
import pytest

from common.geometry.occupancy_grid import OccupancyGrid
from common.messages.definitions import Goal, Map, Plan, Pose, Twist
from common.messages.topics import BELIEF, CMD_VEL, GOAL, MAP, ODOM, PLAN, PREDICTION, PREFERENCE, SCAN, STATUS, TRUTH
from services.viewer.state.frames import encode_frame
from services.viewer.state.history import ChartSample, History
from services.viewer.state.replay_moments import QUIET_TIME_S
from services.viewer.state.robot_view import ANSWER_TIMEOUT_S, RobotView
from tests.viewer.client import read_frame
from tests.viewer.messages import MOTION, PATH, PEOPLE, RANGES, UNMAPPED, at, preference

PERIOD = 1 / 15
REST = (BELIEF, PREDICTION, STATUS, CMD_VEL, PLAN)  # the answers to a scan


def feed(view, stamp, now=None, *leave_out, **how):
    """Adds all messages of a stamp. Returns the resulting frames."""
    now = stamp if now is None else now
    sent = [view.add(t, m, now, round(now * 1e9)) for t, m in at(stamp, **how).items() if t not in leave_out]
    return [read_frame(frame) for frame in sent if frame is not None]


def test_no_truth_beside_a_growing_map():
    view, grid = RobotView("robot"), OccupancyGrid.of(np.zeros((2, 3), np.uint8), 0.5, (1.0, 2.0, 0.0))
    feed(view, 1.0)
    view.add(MAP, Map(stamp_ns=10**9, grid=grid, poses=np.zeros((1, 3)), closures=[[0.0, 1.0], [2.0, 3.0]]), 1.0)
    (frame,) = feed(view, 1.0 + PERIOD)
    assert frame.header["truth"] is frame.header["error"] is None
    shown = json.loads(view.map)
    assert shown["closures"] == [[[0.0, 1.0], [2.0, 3.0]]]
    assert shown["world"]["grid"]["cells"] == grid.cells
    view.end_mapping()
    (frame,) = feed(view, 1.0 + 2 * PERIOD, x=3.0)
    assert view.map is None
    assert frame.header["truth"]["x"] == 3.0


def test_frames():
    view = RobotView("robot")
    feed(view, 1.0)
    (frame,) = feed(view, 1.0 + PERIOD, x=3.0)
    header = frame.header
    assert header["type"] == "frame"
    assert header["robot"] == "robot"
    assert header["stamp_ns"] == round((1.0 + PERIOD) * 1e9)
    assert header["t"] == pytest.approx(1.0 + PERIOD)
    assert header["truth"] == {"x": 3.0, "y": 2.0, "yaw": 0.25, "contact": True, "stopped": False}
    assert (header["belief"]["x"], header["belief"]["state"]) == (3.5, "tracking")
    assert header["belief"]["cov"] == [0.01, 0, 0, 0, 0.04, 0, 0, 0, 0.09]
    (hypothesis,) = header["belief"]["hypotheses"]
    assert hypothesis == {"x": 3.5, "y": 2.0, "yaw": 0.25, "weight": 0.75, "cov": header["belief"]["cov"]}
    assert [header["belief"][k] for k in ("free_energy", "accuracy", "complexity", "estimator")] == [
        12.0, 10.0, 2.0, "precise",
    ]  # fmt: skip
    assert (header["belief"]["probability"], header["belief"]["protection"]) == (0.75, [0.5, 0.25, 0.125])
    assert header["odom"]["x"] == 3.0
    assert header["status"] == {
        "state": "navigating", "reason": "", "distance": 8.0, "goal": {"x": 9.0, "y": 2.0, "yaw": 0.0},
        "energy": None, "exploration": None,
    }  # fmt: skip
    assert header["cmd"] == {"vx": 0.3, "vy": 0.4, "wz": 0.0}
    assert header["error"] == pytest.approx(0.5)
    assert header["speed"] == pytest.approx(0.5)
    assert header["latency_ms"] == 0.0
    assert header["scan"] == {
        "angle_min": -1.0, "angle_increment": 0.5, "range_max": 25.0, "mount": {"x": 0.2, "y": 0.0, "yaw": 0.0},
    }  # fmt: skip
    np.testing.assert_array_equal(frame.arrays["ranges"], RANGES)
    np.testing.assert_array_equal(frame.arrays["predicted"], np.arange(5))
    np.testing.assert_allclose(frame.arrays["sigma"], 0.1)
    for name, points in (("path", PATH), ("motion", MOTION), ("obstacles", UNMAPPED), ("people", PEOPLE)):
        np.testing.assert_array_equal(frame.arrays[name], points.ravel(), err_msg=name)
    assert frame.data == view.frame


@pytest.mark.parametrize("name", ["a", "ab", "abc", "abcd"])
def test_binary_layout(name):
    data = encode_frame(
        {name: "ü"}, {"ranges": np.array([1, np.inf], np.float32), "sigma": np.array([-np.inf], np.float32)}
    )
    (length,) = struct.unpack_from("<I", data)
    assert (4 + length) % 4 == 0
    header = json.loads(data[4 : 4 + length])
    assert header == {name: "ü", "arrays": {"ranges": [0, 2], "sigma": [2, 1]}}
    assert data[4 + length :] == struct.pack("<3f", 1, float("inf"), -float("inf"))


def test_frames_have_finite_numbers():
    with pytest.raises(ValueError, match="JSON"):
        encode_frame({"error": float("nan")}, {})


def test_waiting_for_answers():
    view = RobotView("robot")
    feed(view, 1.0)
    missing = {BELIEF, PREDICTION, STATUS, CMD_VEL, PLAN}
    assert feed(view, 1.1, 1.1, *missing) == []
    assert view.due(1.1) == pytest.approx(ANSWER_TIMEOUT_S)
    assert view.overdue(1.1 + ANSWER_TIMEOUT_S / 2) is None
    frame = read_frame(view.overdue(1.1 + ANSWER_TIMEOUT_S))
    assert frame.header["stamp_ns"] == 1_100_000_000
    assert frame.header["belief"]["stamp_ns"] == 1_000_000_000  # the last belief, with its own stamp
    assert frame.header["error"] == pytest.approx(0.5)  # against the truth of its own stamp
    assert view.due(2.0) is None
    assert view.add(BELIEF, at(1.1)[BELIEF], 1.2) is None  # no second frame of the scan


def test_the_next_scan_ends_the_wait():
    view = RobotView("robot")
    feed(view, 1.0)
    feed(view, 1.1, 1.1, BELIEF, x=5.0)
    frames = [frame.header for frame in feed(view, 1.2, 1.2, x=7.0)]
    assert [(header["stamp_ns"], header["truth"]["x"]) for header in frames] == [
        (1_100_000_000, 5.0), (1_200_000_000, 7.0),
    ]  # fmt: skip


def test_silent_topics_are_not_shown():
    view = RobotView("robot")
    for i in range(60):
        feed(view, i * 0.1, i * 0.1, *({BELIEF, PREDICTION} if i else set()))
        view.overdue(i * 0.1 + ANSWER_TIMEOUT_S)
    (frame,) = feed(view, 6.0, 6.0, BELIEF, PREDICTION)
    assert frame.header["belief"] is frame.header["error"] is None
    assert len(frame.arrays["predicted"]) == len(frame.arrays["sigma"]) == 0
    assert frame.header["cmd"] is not None


def test_topics_during_a_pause():
    view = RobotView("robot")
    feed(view, 1.0)
    assert feed(view, 1.1, 100.0, *REST) == []  # one step after a long pause: the frame waits
    rest = {topic: message for topic, message in at(1.1).items() if topic in REST}
    frames = [view.add(topic, message, 100.01) for topic, message in rest.items()]
    assert read_frame(frames[-1]).header["belief"]["stamp_ns"] == 1_100_000_000


def test_a_scanner_alone_is_shown():
    view = RobotView("bare")
    view.add(SCAN, at(1.0)[SCAN], 1.0)
    frame = read_frame(view.overdue(1.0 + ANSWER_TIMEOUT_S))
    assert {frame.header[name] for name in ("truth", "belief", "status", "cmd")} == {None}
    assert len(frame.arrays["ranges"]) == 5


def test_empty_plans_are_not_waited_for():
    view = RobotView("robot")
    feed(view, 1.0)
    assert feed(view, 1.1, 1.1, PLAN) == []  # there was a plan before
    view.add(PLAN, Plan(stamp_ns=1_100_000_000), 1.11)
    (frame,) = feed(view, 1.2, 1.2, PLAN)
    assert len(frame.arrays["path"]) == len(frame.arrays["obstacles"]) == 0
    assert view.due(1.2) is None


def test_latency():
    view = RobotView("robot")
    feed(view, 1.0)
    for topic, message in at(1.1).items():
        frame = view.add(topic, message, 1.1, 1_100_000_000 + (7_500_000 if topic is CMD_VEL else 0))
    assert read_frame(frame).header["latency_ms"] == pytest.approx(7.5)


def shown(view, now):
    """The frame of a replay, once no message arrives."""
    frame = view.overdue(now + QUIET_TIME_S)
    return frame if frame is None else read_frame(frame)


@pytest.mark.parametrize("seed", range(10))
def test_replays_show_complete_steps(seed):
    view, random = RobotView("ghost", live=False), Random(seed)
    for step in range(1, 5):  # a step ends with the next scan: it has the answers to the last scan, and the scan
        sent = [(t, m) for t, m in at(step - 1.0).items() if t in REST] if step > 1 else []
        sent += [(t, m) for t, m in at(float(step)).items() if t not in REST]
        keys = {topic: [m for t, m in sent if t is topic] for topic, _ in sent}
        order = random.sample([topic for topic, _ in sent], len(sent))  # each key keeps its own order
        assert [view.add(topic, keys[topic].pop(0), float(step)) for topic in order] == [None] * len(sent)
        assert shown(view, step - 0.01) is None  # more messages may arrive
        frame = shown(view, float(step))
        assert frame.header["t"] == (1.0 if step == 1 else step - 1.0)
        assert (frame.header["belief"] is None) == (step == 1)
        if step > 1:
            assert frame.header["belief"]["stamp_ns"] == frame.header["stamp_ns"]
            assert frame.header["error"] == pytest.approx(0.5)
            assert len(frame.arrays["predicted"]) == 5
            assert frame.header["latency_ms"] is None  # of the replay, not of the robot
        assert shown(view, float(step) + 1) is None  # once


def test_seeking_replays():
    view = RobotView("ghost", live=False)
    for stamp in (5.0, 5.1):
        feed(view, stamp, stamp, *(REST if stamp > 5 else ()))
    assert shown(view, 5.1).header["t"] == 5.0
    for stamp in (9.0, 9.1):  # forward
        feed(view, stamp, 6.0, *(REST if stamp > 9 else ()))
    assert shown(view, 6.0).header["t"] == 9.0
    feed(view, 2.0, 7.0)  # back, where no other scan follows
    frame = shown(view, 7.0)
    assert frame.header["stamp_ns"] == frame.header["belief"]["stamp_ns"] == 2_000_000_000
    assert view.time_restarted


def test_fast_replays_are_shown():
    view, times = RobotView("ghost", live=False), []
    for i in range(200):  # ten times as fast
        feed(view, i / 15, i / 150)
        if (frame := view.overdue(i / 150)) is not None:
            times.append(read_frame(frame).header["t"])
    assert 15 <= len(times) <= 25
    assert times == sorted(times)
    assert times[-1] > 198 / 15 - 1.0


def test_replays_of_scans_alone_are_shown():
    view = RobotView("ghost", live=False)
    for i in range(4):
        view.add(SCAN, at(float(i))[SCAN], float(i))
        assert shown(view, float(i)).header["t"] == i


def test_the_end_of_plans_in_a_replay():
    view = RobotView("ghost", live=False)
    feed(view, 1.0)
    feed(view, 1.1, 1.0, PLAN)
    assert shown(view, 1.0).header["t"] == pytest.approx(1.1)


def test_restarted_time_clears_the_history():
    view = RobotView("robot")
    for i in range(5):
        feed(view, 10.0 + i)
    assert view.history.columns()["t"] == [10.0, 11.0, 12.0, 13.0, 14.0]
    assert not view.time_restarted
    (frame, *_) = [*feed(view, 2.0), *feed(view, 3.0)]
    assert view.time_restarted
    assert frame.header["stamp_ns"] <= 3_000_000_000
    assert view.history.columns()["t"] == [2.0, 3.0]


def test_late_messages_are_left_out():
    view = RobotView("robot")
    feed(view, 10.0)
    for topic in (ODOM, TRUTH, SCAN):
        assert view.add(topic, at(9.98)[topic], 10.02) is None
    assert view.stamp_ns == 10_000_000_000
    assert view.history.columns()["t"] == [10.0]
    assert not view.time_restarted
    replay = RobotView("ghost", live=False)
    feed(replay, 10.0)
    feed(replay, 9.98)
    assert replay.time_restarted


def test_history_is_the_last_minute():
    history = History()
    for i in range(100):
        history.add(ChartSample(float(i), i, i, 0.0, None, 0.1))
    columns = history.columns()
    assert columns["t"] == [float(i) for i in range(39, 100)]
    assert {len(column) for column in columns.values()} == {61}
    history.add(ChartSample(99.0, -1, -1, 0.0, 0.5, 0.1))  # a repeated stamp replaces the sample
    assert history.columns()["free_energy"][-2:] == [98, -1]


@pytest.mark.parametrize("order", [(ODOM, TRUTH, SCAN, BELIEF), (ODOM, SCAN, BELIEF, TRUTH)])
def test_history_has_values_of_beliefs(order):
    view, messages = RobotView("robot"), at(1.0)
    for topic in order:
        view.add(topic, messages[topic], 1.0)
    assert view.history.columns() == {
        "t": [1.0], "free_energy": [12.0], "accuracy": [10.0], "complexity": [2.0],
        "error": [pytest.approx(0.5)], "speed": [pytest.approx(0.5)],
    }  # fmt: skip


def test_goal_tolerances():
    view, goal = RobotView("robot"), Pose(x=9.0, y=2.0)
    status = at(1.0)[STATUS].model_copy(update={"goal_seq": 7})

    def shown_goal(number, **tolerances):
        view.add(GOAL, Goal(stamp_ns=0, seq=number, pose=goal, **tolerances), 1.0)
        view.add(STATUS, status, 1.0)
        (frame,) = feed(view, view.stamp_ns * 1e-9 + 0.1, 1.0, STATUS)
        return frame.header["status"]["goal"]

    assert "tolerance" not in shown_goal(3, tolerance=0.5)  # another goal's
    assert shown_goal(7, tolerance=0.5)["yaw_tolerance"] is None
    goal = shown_goal(7, tolerance=0.4, yaw_tolerance=0.15)
    assert (goal["tolerance"], goal["yaw_tolerance"]) == (0.4, 0.15)


def new_field(view):
    data = view.fields.change(view.stamp_ns, live=view.live)
    return data if data is None else read_frame(data)


def test_goal_fields_are_sent_once():
    view = RobotView("robot")
    feed(view, 5.0)
    assert new_field(view) is None
    view.add(PREFERENCE, preference(5.0), 5.0)
    field = new_field(view)
    assert field.header == {
        "type": "field", "robot": "robot", "t": 5.0, "goal": {"x": 9.0, "y": 2.0, "yaw": 0.0},
        "origin": {"x": -1.0, "y": -2.0}, "resolution": 0.5, "width": 3, "height": 2, "arrays": {"distance": [0, 6]},
    }  # fmt: skip
    np.testing.assert_array_equal(field.arrays["distance"], [0, 1, 2, 3, 4, np.inf])
    feed(view, 6.0)
    assert new_field(view) is None
    feed(view, 1.0)  # the simulation was restarted; its goal is the same
    assert view.time_restarted
    assert view.fields.shown == field.data
    view.add(PREFERENCE, preference(1.0, x=3.0), 7.0)
    assert new_field(view).header["goal"]["x"] == 3.0


def test_goal_fields_of_replays():
    view = RobotView("ghost", live=False)
    for stamp, x in ((1.0, 1.0), (5.0, 5.0)):
        view.add(PREFERENCE, preference(stamp, x), stamp)
        feed(view, stamp)
        assert new_field(view).header["goal"]["x"] == x
    feed(view, 3.0)  # back
    assert new_field(view).header["goal"]["x"] == 1.0
    feed(view, 0.5)
    assert new_field(view) is None
    feed(view, 6.0)
    assert new_field(view).header["goal"]["x"] == 5.0


def test_large_goal_fields_are_subsampled():
    view, side = RobotView("robot"), 401
    view.add(PREFERENCE, preference(1.0, width=side, height=side), 1.0)
    field = new_field(view)
    header, values = field.header, field.arrays["distance"]
    assert header["width"] == header["height"] == 134
    assert header["resolution"] == 1.5
    for cell in (0, 77, 134 * 50 + 3):
        row, column = divmod(cell, 134)
        x, y = (header["origin"][k] + (n + 0.5) * 1.5 for k, n in (("x", column), ("y", row)))
        old = int((y + 2) / 0.5) * side + int((x + 1) / 0.5)
        assert values[cell] == old
        assert (x + 1) / 0.5 % 1 == pytest.approx(0.5)  # the centre of a cell


def test_the_journal_has_changes_of_state():
    view = RobotView("robot")

    def add(stamp, state, reason=""):
        view.add(STATUS, at(stamp)[STATUS].model_copy(update={"state": state, "reason": reason}), stamp)
        changed, view.journal_changed = view.journal_changed, False
        return changed

    assert add(1.0, "navigating")
    assert not add(1.1, "navigating")
    assert add(2.0, "blocked", "an obstacle is 0.52 m ahead")
    assert not add(2.1, "blocked", "an obstacle is 0.49 m ahead")  # numbers go on changing
    assert add(3.0, "blocked", "no way round")
    assert not add(3.1, "blocked")
    assert not add(3.2, "blocked", "no way round")
    assert [(row["t"], row["state"], row["reason"]) for row in view.journal.rows()] == [
        (1.0, "navigating", ""), (2.0, "blocked", "an obstacle is 0.52 m ahead"), (3.0, "blocked", "no way round"),
    ]  # fmt: skip
    for i in range(50):
        assert add(4.0 + i, ("idle", "navigating")[i % 2])
    assert len(view.journal.rows()) == 20
    feed(view, 60.0)
    feed(view, 1.0)  # back
    assert [row["t"] for row in view.journal.rows()] == [1.0]


@pytest.mark.parametrize(
    ("x", "yaw", "seconds", "carried"),
    [
        (1.05, 0.25, 0.1, False),  # driven, at 0.5 m/s
        (1.45, 0.25, 0.5, False),  # driven, faster towards the end
        (1.3, 0.25, 0.1, True),
        (9.0, 0.25, 0.1, True),
        (1.0, 0.4, 0.1, False),
        (1.0, 3.0, 0.1, True),  # turned on the spot by hand
        (1e4, 0.25, 0.1, True),  # the largest coordinate of a message
    ],
)
def test_carried_robots_are_in_the_journal(x, yaw, seconds, carried):
    view = RobotView("robot")
    feed(view, 1.0)
    later = at(1.0 + seconds)
    truth = later[TRUTH].model_copy(update={"pose": Pose(x=x, y=2.0, yaw=yaw)})
    view.add(TRUTH, truth, 1.0 + seconds)
    view.add(STATUS, later[STATUS], 1.0 + seconds)
    rows = view.journal.rows()
    assert [row["state"] for row in rows] == ["navigating", *["carried"] * carried]
    if x == 9.0:
        assert rows[-1]["t"] == pytest.approx(1.1)
        assert rows[-1]["reason"].startswith("8.0 m, to (9.00, 2.00)")


def test_infinite_results_are_none():
    view, messages = RobotView("robot"), at(1.1)
    feed(view, 1.0)
    far = Pose.model_construct(x=1e308, y=0.0, yaw=0.0)  # no message from the wire can hold it
    messages[BELIEF] = messages[BELIEF].model_copy(update={"pose": far, "hypotheses": []})
    messages[TRUTH] = messages[TRUTH].model_copy(
        update={
            "pose": Pose.model_construct(x=-1e308, y=0.0, yaw=0.0),
            "twist": Twist.model_construct(vx=1.5e308, vy=1.5e308, wz=0.0),
        }
    )
    for topic, message in messages.items():
        view.add(topic, message, 1.1)
    header = read_frame(view.frame).header
    assert (header["error"], header["speed"], header["belief"]["x"]) == (None, None, 1e308)
    huge = preference(1.0, width=401, height=401).model_copy(update={"resolution": 1e308})
    view.add(PREFERENCE, huge, 1.0)
    assert new_field(view) is None
