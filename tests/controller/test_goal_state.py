"""The table of transitions of a goal's phase."""

from __future__ import annotations

import numpy as np
import pytest

from services.controller.goal_state import GoalState
from services.controller.policies.decision import Decision
from tests.controller.driving import goal


def event(method, *args, **more):
    return lambda state: method(state, *args, **more)


def progress(seconds, *, at=(0, 0, 0), moving=True, limited=False, **decision):
    pose, now_ns = np.array(at, dtype=float), round(seconds * 1e9)
    return event(GoalState.update_progress, now_ns, pose, Decision(**decision), moving=moving, limited_by_scan=limited)


START, REFUSED = (event(GoalState.start, goal(1, 2), refusal) for refusal in (None, "in a wall"))
REFUSE, REACH = event(GoalState.refuse, "far"), event(GoalState.reach, "near")
LOSE, EXPLORE = (event(GoalState.lose_pose, activity, "unsure") for activity in ("lost", "exploring"))
NO_BELIEF, FIND = event(GoalState.lose_belief, "no belief"), GoalState.find_pose
CANCEL, SUSPEND = GoalState.cancel, GoalState.suspend
IN_THE_WAY = "an obstacle in the scan is in the way"
SLOWED = "slowed for an obstacle in the scan"
FREE, HINDERED = progress(0), progress(1, limited=True)


@pytest.mark.parametrize(
    ("events", "shown", "reason", "active"),
    [
        ([], "idle", "", False),
        ([NO_BELIEF], "idle", "", False),
        ([START], "navigating", "", True),
        ([REFUSED], "blocked", "goal refused: in a wall", False),
        ([REFUSED, NO_BELIEF, SUSPEND, progress(9)], "blocked", "goal refused: in a wall", False),
        ([REFUSED, START], "navigating", "", True),
        ([START, REFUSE], "blocked", "goal refused: far", False),
        ([START, CANCEL], "idle", "cancelled", False),
        ([START, CANCEL, SUSPEND], "idle", "", False),
        ([START, REACH], "reached", "near", False),
        ([START, REACH, NO_BELIEF], "reached", "near", False),
        ([START, REACH, SUSPEND], "idle", "", False),
        ([START, LOSE], "lost", "unsure", True),
        ([START, LOSE, EXPLORE, progress(9)], "exploring", "unsure", True),
        ([START, EXPLORE, NO_BELIEF], "lost", "no belief", True),
        ([START, NO_BELIEF, FIND], "navigating", "", True),
        ([START, NO_BELIEF, SUSPEND], "navigating", "", True),
        ([START, HINDERED], "navigating", SLOWED, True),
        ([START, HINDERED, progress(2.9, limited=True)], "navigating", SLOWED, True),
        ([START, HINDERED, progress(3, limited=True)], "blocked", IN_THE_WAY, True),
        ([START, HINDERED, progress(3, state="blocked", reason="a box")], "blocked", "a box", True),
        ([START, HINDERED, progress(3, reason="slow")], "navigating", "slow", True),
        ([START, HINDERED, FREE, progress(3, limited=True)], "navigating", SLOWED, True),
        ([START, HINDERED, progress(3, limited=True), FREE], "navigating", "", True),
        ([START, HINDERED, progress(3, at=(0, 0.01, 0.01), limited=True)], "blocked", IN_THE_WAY, True),
        ([START, HINDERED, progress(3, at=(0, 0.03, 0), limited=True)], "navigating", SLOWED, True),
        ([START, HINDERED, progress(3, at=(0, 0, 0.1), limited=True)], "navigating", SLOWED, True),
        ([START, HINDERED, progress(3, at=(0, 9, 0), moving=False, limited=True)], "blocked", IN_THE_WAY, True),
        ([START, progress(0, recovering=True, reason="backs off")], "blocked", "backs off", True),
        ([START, progress(0, recovering=True), LOSE, FIND], "navigating", "", True),
    ],
)
def test_transitions(events, shown, reason, active):
    state = GoalState()
    for apply in events:
        apply(state)
    status = state.status(7, 0.5)
    assert (status.state, status.reason, state.active) == (shown, reason, active)
    assert (status.stamp_ns, status.distance) == (7, 0.5)
    assert status.refused == (shown == "blocked" and not active)
    assert (status.goal is None) == (shown == "idle")
