from __future__ import annotations

import json

import numpy as np
import pytest

from common.errors import UserError
from common.messages.definitions import Belief, Goal, Pose, Truth, Twist
from common.messages.topics import BELIEF, GOAL, HEALTH, PREDICTION, SCAN, STATUS, TOPICS, TRUTH
from presage.recordings.session_summary import load_session, summarise
from services.recorder.files.writer import RecordingWriter
from tests.recorder import sessions as made


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return made.write(tmp_path_factory.mktemp("session") / "run.mcap")


def test_the_summary_is_what_the_hand_works_out(recording):
    summary = summarise(recording)
    assert (summary.world, summary.robot, summary.complete) == ("hall", "robot", True)
    assert summary.scans == 100
    assert summary.messages == 4 * 100 + 1 + 70 + 4
    assert summary.undecodable == 0
    assert summary.dropped == 7  # the last health of each service, not the sum over time
    assert summary.dropped_by_key == {"presage/robot/scan": 7}
    assert summary.duration_s == pytest.approx(10.0)
    assert summary.duration_stamped_s == pytest.approx(9.9)
    assert summary.localised_after_scans == 21
    assert summary.localised_after_s == pytest.approx(2.0)
    assert summary.localised_error_m == pytest.approx(0.05)
    # The truth ends at 1 + 0.1 * 69 = 7.9, the belief 0.2 further.
    assert summary.goal_reached is True
    assert summary.goal_distance_m == pytest.approx(0.1)
    assert summary.goal_distance_believed_m == pytest.approx(0.1)
    assert summary.position_error_m == pytest.approx(0.2)
    # Scans 20 to 30 at 0.05 m, 31 to 99 at 0.2 m.
    assert summary.position_error_median_m == pytest.approx(0.2)
    assert summary.position_error_max_m == pytest.approx(0.2)
    assert summary.position_error_navigating_median_m == pytest.approx(0.2)
    assert summary.path_m == pytest.approx(6.9)
    assert summary.straight_line_m == pytest.approx(7.0)
    assert summary.contacts == 3


def test_navigating_begins_with_the_goal_and_ends_when_it_is_reached(recording):
    session = load_session(recording)
    assert session.goal_times_ns == [made.MOVED * made.PERIOD_NS]  # though the goal's own stamp is 0
    # The belief 1.2 + 0.1 (i - 30) first lies within 0.15 m of 8 at i = 97.
    assert session.reached_ns() == 97 * made.PERIOD_NS


def test_the_summary_is_plain_data_and_lines(recording):
    summary = summarise(recording)
    assert json.loads(json.dumps(summary.as_dict())) == summary.as_dict()
    lines = dict(summary.lines())
    assert lines["goal"] == "reached"
    assert lines["distance to goal"] == "0.100 m, believed 0.100 m"
    assert "incomplete" not in lines


def test_what_is_not_recorded_is_none_not_zero(tmp_path):
    summary = summarise(
        made.write(tmp_path / "scans.mcap", TRUTH, BELIEF, PREDICTION, GOAL, STATUS, HEALTH, world=False)
    )
    told = {name for name, value in summary.as_dict().items() if value is not None}
    assert told == {
        "robot", "complete", "scans", "messages", "undecodable", "duration_s", "duration_stamped_s", "dropped_by_key",
    }  # fmt: skip
    assert dict(summary.lines())["localised"] == "never"


def test_a_session_without_any_message(tmp_path):
    summary = summarise(made.write(tmp_path / "empty.mcap", *TOPICS, world=False))
    assert (summary.scans, summary.messages, summary.duration_s) == (0, 0, 0.0)
    assert summary.position_error_m is None


def test_without_truth_no_error_is_claimed(tmp_path):
    summary = summarise(made.write(tmp_path / "real.mcap", TRUTH))
    assert summary.localised_after_scans == 21
    assert summary.localised_error_m is None
    assert summary.position_error_m is None
    assert summary.position_error_max_m is None
    assert summary.path_m is None
    assert summary.contacts is None
    assert summary.goal_reached is True  # the controller said so
    assert summary.goal_distance_m is None
    assert summary.goal_distance_believed_m == pytest.approx(0.1)


def write(path, *entries):
    writer = RecordingWriter(path)
    for number, (topic, message) in enumerate(entries):
        writer.write(topic, topic.key("robot"), message.encode(), number, number)
    return writer.finish()


def truth(stamp, x, y=0.0):
    return TRUTH, Truth(stamp_ns=stamp, pose=Pose(x=x, y=y), twist=Twist())


def belief(stamp, x, y=0.0, state="tracking"):
    pose = Pose(x=x, y=y)
    return BELIEF, Belief(
        stamp_ns=stamp, state=state, pose=pose, xi=np.zeros(3, np.float32), free_energy=1.0, accuracy=1.0
    )


def test_a_belief_is_compared_with_the_truth_of_its_own_stamp(tmp_path):
    path = write(
        tmp_path / "late.mcap", truth(0, 0.0), truth(1, 1.0), belief(0, 0.3, 0.4), truth(2, 2.0), belief(5, 9.0)
    )
    errors = load_session(path).errors()
    assert errors[0] == pytest.approx(0.5)
    assert np.isnan(errors[1])  # no truth of that stamp
    assert summarise(path).position_error_m is None


def test_a_simulation_that_began_anew_uses_stamps_twice(tmp_path):
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


def test_one_message_sent_again_counts_once(tmp_path):
    again = [truth(0, 0.0), belief(0, 1.0, state="localising")] * 3
    path = write(tmp_path / "again.mcap", *again, truth(1, 0.0), belief(1, 0.5))
    # Alternating topics: each is compared with the last of its own kind.
    assert summarise(path).localised_after_scans == 2
    assert summarise(path).messages == 8


def test_a_cancelled_goal_is_no_goal(tmp_path):
    goal = Goal(stamp_ns=0, pose=Pose(x=1, y=1))
    path = write(
        tmp_path / "cancel.mcap", truth(0, 0.0), (GOAL, goal), (GOAL, goal.model_copy(update={"cancel": True}))
    )
    assert summarise(path).goal_reached is None
    assert summarise(path).goal_distance_m is None


def test_an_unreadable_payload_is_counted_in_the_summary(tmp_path):
    writer = RecordingWriter(tmp_path / "bad.mcap")
    writer.write(SCAN, SCAN.key("robot"), b"\xc1nonsense", 1, 1)
    assert summarise(writer.finish()).undecodable == 1


def test_no_file(tmp_path):
    with pytest.raises(UserError, match=r"no\.mcap: cannot be read"):
        summarise(tmp_path / "no.mcap")
