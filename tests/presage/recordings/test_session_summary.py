"""The summary of a session, against values worked out by hand from tests/recorder/sessions.py."""

from __future__ import annotations

import json

import numpy as np
import pytest

from common.errors import UserError
from common.messages.definitions import Belief, Goal, Pose, Scan, Status, Truth, Twist
from common.messages.topics import BELIEF, GOAL, HEALTH, PREDICTION, SCAN, STATUS, TOPICS, TRUTH
from presage.recordings.session_summary import load_session, summarise
from services.recorder.files.writer import RecordingWriter
from tests.recorder import sessions as made


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return made.write(tmp_path_factory.mktemp("session") / "run.mcap")


def test_summary(recording):
    summary = summarise(recording).as_dict()
    expected = {
        "world": "hall", "robot": "robot", "complete": True, "scans": 100, "messages": 4 * 100 + 1 + 70 + 4,
        "undecodable": 0, "dropped": 7,  # the last health of each service, not the sum over time
        "duration_s": 10.0, "duration_stamped_s": 9.9, "localised_after_scans": 21, "localised_after_s": 2.0,
        "localised_error_m": 0.05,
        # The truth ends at 1 + 0.1 * 69 = 7.9, the belief 0.2 further.
        "goal_reached": True, "goal_distance_reached_m": 0.3, "goal_distance_m": 0.1, "goal_distance_believed_m": 0.1,
        "position_error_m": 0.2,
        # Scans 20 to 30 at 0.05 m, 31 to 99 at 0.2 m.
        "position_error_median_m": 0.2, "position_error_max_m": 0.2, "position_error_navigating_median_m": 0.2,
        "path_m": 6.9, "straight_line_m": 7.0, "contacts": 3,
    }  # fmt: skip
    assert {name: summary[name] for name in expected} == pytest.approx(expected)
    assert json.loads(json.dumps(summary)) == summary
    lines = dict(summarise(recording).lines())
    assert (lines["goal"], lines["distance to goal"]) == ("believed reached", "0.100 m, believed 0.100 m")
    assert lines["skipped by services"] == "7 scan, for newer ones; undecodable 0"
    assert "incomplete" not in lines


def test_time_of_navigating(recording):
    session = load_session(recording)
    assert session.goal_times_ns == [made.MOVED * made.PERIOD_NS]  # though the goal's own stamp is 0
    # The belief 1.2 + 0.1 (i - 30) first lies within 0.15 m of 8 at i = 97.
    assert session.reached_ns() == 97 * made.PERIOD_NS


def test_missing_topics_give_none(tmp_path):
    scans = summarise(made.write(tmp_path / "s.mcap", TRUTH, BELIEF, PREDICTION, GOAL, STATUS, HEALTH, world=False))
    known = {name for name, value in scans.as_dict().items() if value is not None}
    assert known == {
        "robot", "complete", "scans", "messages", "undecodable", "duration_s", "duration_stamped_s", "dropped_by_key",
        "localised_before_recording",
    }  # fmt: skip
    assert dict(scans.lines())["localised"] == "never"
    empty = summarise(made.write(tmp_path / "empty.mcap", *TOPICS, world=False))
    assert (empty.scans, empty.duration_s, empty.position_error_m) == (0, 0.0, None)
    real = summarise(made.write(tmp_path / "real.mcap", TRUTH)).as_dict()
    names = ("localised_error_m", "position_error_m", "position_error_max_m", "path_m", "contacts", "goal_distance_m")
    assert [real[name] for name in names] == [None] * len(names)
    assert (real["goal_reached"], real["localised_after_scans"]) == (True, 21)  # the controller reported it


def write(path, *entries):
    writer = RecordingWriter(path)
    for number, (topic, message) in enumerate(entries):
        writer.write(topic, topic.key("robot"), message.encode(), number, number)
    return writer.finish()


def truth(stamp, x, y=0.0):
    return TRUTH, Truth(stamp_ns=stamp, pose=Pose(x=x, y=y), twist=Twist())


def belief(stamp, x, y=0.0, state="tracking", estimator="precise"):
    pose = Pose(x=x, y=y)
    return BELIEF, Belief(
        stamp_ns=stamp,
        state=state,
        pose=pose,
        xi=np.zeros(3, np.float32),
        free_energy=1.0,
        accuracy=1.0,
        estimator=estimator,
    )


def test_error_at_the_beliefs_stamp(tmp_path):
    path = write(
        tmp_path / "late.mcap", truth(0, 0.0), truth(1, 1.0), belief(0, 0.3, 0.4), truth(2, 2.0), belief(5, 9.0)
    )
    errors = load_session(path).errors()
    assert errors[0] == pytest.approx(0.5)
    assert np.isnan(errors[1])  # no truth of that stamp
    assert summarise(path).position_error_m is None


def test_error_while_mapping(tmp_path):
    beliefs = [belief(k, k, estimator="mapper") for k in range(3)]
    goal = GOAL, Goal(stamp_ns=0, pose=Pose(x=2, y=0.5))
    path = write(tmp_path / "map.mcap", truth(0, 7.0, 2.0), truth(1, 8.0, 2.0), goal, truth(2, 9.0, 2.5), *beliefs)
    assert load_session(path).errors() == pytest.approx([0.0, 0.0, 0.5])
    assert summarise(path).goal_distance_m == pytest.approx(0.0)


def test_error_after_a_restart(tmp_path):
    path = write(
        tmp_path / "reset.mcap",
        truth(0, 0.0),
        belief(0, 1.0),
        truth(1, 5.0),
        truth(0, 3.0),
        belief(1, 5.0),
        belief(0, 3.0),
    )
    assert load_session(path).errors() == pytest.approx([1.0, 0.0, 0.0])


def test_repeated_messages_count_once(tmp_path):
    again = [truth(0, 0.0), belief(0, 1.0, state="localising")] * 3
    path = write(tmp_path / "again.mcap", *again, truth(1, 0.0), belief(1, 0.5))
    # Alternating topics: each is compared with the last of its own kind.
    assert summarise(path).localised_after_scans == 2
    assert summarise(path).messages == 8


def test_cancelled_goal(tmp_path):
    goal = Goal(stamp_ns=0, pose=Pose(x=1, y=1))
    path = write(
        tmp_path / "cancel.mcap", truth(0, 0.0), (GOAL, goal), (GOAL, goal.model_copy(update={"cancel": True}))
    )
    assert summarise(path).goal_reached is None
    assert summarise(path).goal_distance_m is None


@pytest.mark.parametrize(
    ("x_reached", "x_end", "result"), [(8.1, 4.0, "reached"), (7.7, 8.0, "believed reached"), (None, 4.0, "reached")]
)
def test_goal_reached_only_in_the_belief(tmp_path, x_reached, x_end, result):
    """Where the robot is later does not count."""
    goal = Goal(stamp_ns=0, pose=Pose(x=8.0, y=0.0), tolerance=0.15)
    reached = STATUS, Status(stamp_ns=1, state="reached", goal=goal.pose)
    arrival = [] if x_reached is None else [truth(1, x_reached)]
    path = write(tmp_path / "goal.mcap", truth(0, 1.0), (GOAL, goal), *arrival, reached, truth(2, x_end))
    assert summarise(path).goal_result() == result


def test_refused_goal(tmp_path):
    reason = "goal refused: (400.00, 1.00) is off the map"
    pose = Pose(x=400, y=1)
    refused = Status(stamp_ns=1, state="blocked", reason=reason, refused=True, goal=pose)
    path = write(tmp_path / "refused.mcap", truth(0, 0.0), (GOAL, Goal(stamp_ns=0, pose=pose)), (STATUS, refused))
    assert (summarise(path).goal_reached, summarise(path).goal_refusal) == (False, reason)
    assert dict(summarise(path).lines())["goal"] == "refused: (400.00, 1.00) is off the map"


@pytest.mark.parametrize(
    ("seq", "expected"), [(0, "after 1 scan, with an error of 0.500 m"), (7, "before the recording began")]
)
def test_localised_at_the_first_scan(tmp_path, seq, expected):
    scan = SCAN, Scan.of_scanner(made.SCANNER, np.ones(made.SCANNER.beams), 0).model_copy(update={"seq": seq})
    path = write(tmp_path / "begun.mcap", truth(0, 0.0), scan, belief(0, 0.5))
    assert dict(summarise(path).lines())["localised"] == expected
    assert summarise(path).localised_before_recording == bool(seq)


def test_unreadable_payload_and_file(tmp_path):
    writer = RecordingWriter(tmp_path / "bad.mcap")
    writer.write(SCAN, SCAN.key("robot"), b"\xc1nonsense", 1, 1)
    assert summarise(writer.finish()).undecodable == 1
    with pytest.raises(UserError, match=r"no\.mcap: cannot be read"):
        summarise(tmp_path / "no.mcap")
