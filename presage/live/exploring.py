"""`presage explore`: begins an exploration, shows its progress, and stops the robot on Ctrl-C."""

from __future__ import annotations

import time

from rich.console import Console

from common.bus.bus import Link
from common.errors import UserError
from common.messages.definitions import Exploration, Goal, Pose, Status
from common.messages.topics import GOAL, STATUS
from presage.live.latest_messages import LatestMessages, session_bus
from presage.terminal.progress import status_line

ANSWER_TIMEOUT_S = 3.0
STATUS_TIMEOUT_S = 30.0  # long enough to restart the mapper meanwhile


def explore(link: Link, console: Console) -> int:
    """Explores until everything that can be reached is mapped; returns 0 then, and 1 if that fails."""
    with session_bus(link) as bus:
        messages = LatestMessages(bus, STATUS)
        if not bus.wait_matching(GOAL, ANSWER_TIMEOUT_S):
            raise UserError("no controller is running: start one with `presage up --mapping`")
        messages.wait_for(Status, lambda _: True, ANSWER_TIMEOUT_S)  # else the controller may not receive goals yet
        request = Goal(stamp_ns=0, seq=time.time_ns(), pose=Pose(x=0.0, y=0.0), explore=True)
        try:
            bus.put(GOAL, request.encode())
            return _follow(messages, request.seq, console)
        except KeyboardInterrupt:
            if _stop(messages, request):
                console.print("stopped; `presage save-map NAME` saves the map so far")
            else:
                console.print("the stop was sent, but not confirmed by the controller: the robot may still drive")
            raise


def _follow(messages: LatestMessages, seq: int, console: Console) -> int:
    status = messages.wait_for(Status, lambda s: _progress(s, seq) is not None or s.goal_seq == seq, ANSWER_TIMEOUT_S)
    if status is None:
        raise UserError("the controller did not begin to explore within 3 s: `presage doctor` finds the cause")
    began_ns = status.stamp_ns
    with status_line("exploring", console) as show:
        while status is not None:
            progress = _progress(status, seq)
            if progress is None:
                raise UserError(
                    status.reason if status.refused else "the exploration was cancelled, or another one began"
                )
            began_ns = began_ns or status.stamp_ns  # before the first belief, stamps are 0
            so_far = f"{progress.area:.0f} m² mapped, {progress.path:.1f} m driven"
            state = "" if status.state == "exploring" else status.state  # the phase says so already
            doing = ": ".join(filter(None, (state, status.reason)))
            show(f"{progress.phase}: {so_far}; {doing}", f"{progress.phase} {doing}")
            if progress.phase == "finished":
                seconds = (status.stamp_ns - began_ns) * 1e-9
                console.print(f"finished: {so_far} in {seconds:.0f} s; the robot is back where it began")
                console.print("`presage save-map NAME` saves the map")
                return 0
            if progress.phase == "failed":
                console.print(f"the exploration failed: {status.reason}; {so_far}")
                return 1
            status = messages.wait_for(Status, lambda _: True, STATUS_TIMEOUT_S)
    raise UserError(f"the controller has published no status for {STATUS_TIMEOUT_S:g} s")


def _progress(status: Status, seq: int) -> Exploration | None:
    """The progress of the exploration with this number, or None if the status describes no or another exploration."""
    return status.exploration if status.exploration is not None and status.exploration.seq == seq else None


def _stop(messages: LatestMessages, request: Goal) -> bool:
    """Ends the exploration; returns whether the controller confirms it."""
    messages.bus.put(GOAL, request.model_copy(update={"cancel": True}).encode())
    ended = messages.wait_for(Status, lambda s: s.exploration is None and s.state == "idle", ANSWER_TIMEOUT_S)
    return ended is not None
