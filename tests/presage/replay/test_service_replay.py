"""`presage replay --with`: pairs of recorded and new messages, times of goals, and the verdict."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.messages.definitions import Belief, CmdVel, Pose, Status, Twist
from presage.replay.goal_times import GoalTimes
from presage.replay.replay_outcome import MessagePairs, ReplayOutcome
from presage.replay.service_replay import build_services, describe
from services.recorder.files.writer import RecordingWriter
from services.recorder.reader import read_recording


def belief(stamp, x=0.0, state="tracking", covariance=None, free_energy=1.0):
    return Belief(
        stamp_ns=stamp, state=state, pose=Pose(x=x, y=0.0), covariance=covariance, free_energy=free_energy, accuracy=1.0
    )


STAMPS = st.lists(st.integers(0, 5), max_size=20)


@given(STAMPS, STAMPS, st.randoms(use_true_random=False))
def test_pairs_in_any_order(old, new, random):
    """Free energy is 10 k + stamp for the k-th belief of a stamp, so that equal means the right two were paired."""
    queues = [[(stamp, stamps[:i].count(stamp)) for i, stamp in enumerate(stamps)] for stamps in (old, new)]
    pairs = MessagePairs()
    while any(queues):
        side = random.choice([side for side in (0, 1) if queues[side]])
        stamp, k = queues[side].pop(0)
        (pairs.add_recorded, pairs.add_new)[side](belief(stamp, free_energy=10.0 * k + stamp))
    expected = sum(min(old.count(stamp), new.count(stamp)) for stamp in set(old))
    assert pairs.compared == pairs.equal == expected
    assert pairs.unmatched() == {"recorded": len(old) - expected, "new": len(new) - expected}


@pytest.mark.parametrize(
    "other",
    [
        belief(1, x=1e-16),
        belief(1, free_energy=np.nextafter(1.0, 2)),
        belief(1, free_energy=None),
        belief(1, covariance=np.eye(3)),
        belief(1, state="lost"),
    ],
)
def test_single_bit_is_noticed(other):
    outcome = ReplayOutcome(lockstep=True)
    outcome.beliefs.add_recorded(belief(1))
    outcome.beliefs.add_new(other)
    assert (outcome.beliefs.compared, outcome.beliefs.equal, outcome.agrees) == (1, 0, False)
    assert ReplayOutcome(lockstep=False, beliefs=outcome.beliefs).agrees  # within the tolerance


def test_verdict_needs_a_comparison():
    for lockstep in (True, False):
        assert not ReplayOutcome(lockstep).agrees
        assert "check whether a service ran before the recording began" in describe(ReplayOutcome(lockstep))[-1]
    outcome = ReplayOutcome(lockstep=True)
    outcome.beliefs.add_recorded(belief(1))
    outcome.beliefs.add_new(belief(1))
    assert outcome.agrees
    assert "check" not in describe(outcome)[-1]
    outcome.damaged = "damaged: a chunk's checksum"
    assert not outcome.agrees
    assert "what comes after that was not compared" in describe(outcome)[-1]


def test_commands_compare_by_velocity():
    pairs = MessagePairs()
    for stamp, old, new in ((1, 1.0, 1.0), (2, 1.0, 0.75)):
        pairs.add_recorded(CmdVel(stamp_ns=stamp, seq=5, twist=Twist(vx=old)))
        pairs.add_new(CmdVel(stamp_ns=stamp, seq=9, twist=Twist(vx=new)))
    assert (pairs.compared, pairs.equal, pairs.max_speed_difference) == (2, 1, 0.25)


def controller(*entries):
    """The messages of a controller: "g" is an accepted goal, a number the stamp of an answered belief."""
    goals, last, goal, messages = GoalTimes(), 0, None, []
    for entry in entries:
        if entry == "g":
            goal = Pose(x=1.0, y=1.0)
            messages.append(Status(stamp_ns=last, state="navigating", goal=goal))
        else:
            last = entry
            distance = 1.0 if goal else None
            messages.append(Status(stamp_ns=last, state="idle", goal=goal, distance=distance))
            messages.append(CmdVel(stamp_ns=last, twist=Twist()))
    goals.add(messages)
    return goals


@pytest.mark.parametrize(
    ("entries", "count", "expected"),
    [
        ((1, 2, "g", 3, "g", "g", 4), 3, {2: 1, 3: 2}),
        (("g", 0, 1), 1, {None: 1}),
        ((0, "g", 1), 1, {0: 1}),
        ((1, 2), 0, {}),
        ((1, "g", 2), 2, None),  # one goal was not accepted
        ((), 1, None),
    ],
)
def test_goal_times(entries, count, expected):
    assert controller(*entries).accepted(count) == expected


def test_goal_times_at_a_cut_end():
    goals = controller(1, "g", 2)
    goals.add([Status(stamp_ns=3, state="navigating", goal=Pose(x=1.0, y=1.0), distance=1.0)])
    assert goals.accepted(1) == {1: 1, 3: 0}


def test_estimator_of_ones_own(tmp_path):
    """It cannot be run again: presage's estimator would be blamed on the session."""
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.metadata("config:estimator", {"config": json.dumps({"robot": "robot", "start": "0,0,0"})})
    recording = read_recording(writer.finish())
    with pytest.raises(UserError, match=r"made with another program as estimator.*`presage rerun "):
        build_services(recording, ("estimator",), tmp_path, [])
