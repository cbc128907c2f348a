"""The commands goal, teleport, relocalise, save-map, save-model, topics, hz and echo."""

from __future__ import annotations

import json
import time
from collections import defaultdict
from typing import Any

import numpy as np
from pydantic import BaseModel
from rich.console import Console
from rich.table import Table

from common.bus.bus import Link, wait_until
from common.bus.inbox import Inbox, Sample
from common.errors import UserError
from common.geometry.se2 import Array
from common.messages.definitions import Belief, Goal, Pose, Status
from common.messages.requests import (
    LocaliseRequest,
    PoseRequest,
    Reply,
    SaveMapReply,
    SaveMapRequest,
    SaveModelReply,
    SaveModelRequest,
)
from common.messages.topics import (
    BELIEF,
    GOAL,
    LOCALISE,
    QUERIES,
    SAVE_MAP,
    SAVE_MODEL,
    STATUS,
    TELEPORT,
    TOPICS,
    Topic,
)
from common.messages.wire import DecodeError, Message
from common.runtime.session_files import session_of
from presage.live.latest_messages import LatestMessages, session_bus
from presage.terminal.progress import status_line

# By the stamps of the messages. A person who blocks the robot usually moves on sooner.
PROGRESS_TIMEOUT_S = 30.0
MIN_APPROACH_M = 0.3  # decrease of the least distance to the goal that counts as progress
# A motion this far also counts, because the way around a wall may lead away from the goal; backing off is shorter.
MIN_MOTION_M = 1.0
# Without statuses from the controller: time until a note is printed, and until the command gives up.
STATUS_WARNING_S, STATUS_TIMEOUT_S = 3.0, 30.0
LOCALISATION_TIMEOUT_S = 10.0  # preset paper takes 3 s
DISCOVERY_TIMEOUT_S, SAVE_TIMEOUT_S = 3.0, 30.0  # a large map takes a while to save
MAX_TEXT = 200  # characters; longer texts are shortened
GOAL_STAYS = "the robot keeps its goal; `presage goal --cancel` stops it"


def topic_named(name: str) -> Topic:
    """The row of the table of topics with this name; raises UserError if there is none."""
    for topic in TOPICS:
        if topic.name == name:
            return topic
    raise UserError(f"no topic {name!r}: choose one of {', '.join(t.name for t in TOPICS)}")


def send_goal(link: Link, goal: Goal, console: Console, *, wait: bool) -> int:
    """Sends or cancels a goal; returns 0 if it is accepted (with ``wait``: reached), else 1."""
    with session_bus(link) as bus:
        messages = LatestMessages(bus, STATUS, BELIEF)
        if not bus.wait_matching(GOAL, 3.0):
            raise UserError("no controller receives goals: is it running?")
        status = messages.wait_for(Status, lambda _: True, STATUS_WARNING_S)
        # Without beliefs, a robot that stands has no status, but it would drive on later if its goal stayed.
        if status is None and not goal.cancel:
            raise UserError(
                "the controller publishes no status: does it receive beliefs? `presage doctor` finds the cause"
            )
        bus.put(GOAL, goal.model_copy(update={"stamp_ns": status.stamp_ns if status else 0}).encode())
        if goal.cancel:
            done = messages.wait_for(Status, lambda s: s.state == "idle", 3.0)
            console.print("cancelled; the robot stops" if done else "sent, but not confirmed by the controller")
            return 0 if done else 1
        if (status := messages.wait_for(Status, lambda s: s.goal_seq == goal.seq, 3.0)) is None:
            raise UserError("the controller did not acknowledge the goal within 3 s")
        if status.refused:
            raise UserError(status.reason)
        console.print(f"going to {_place(goal.pose, goal.map_id)}")
        try:
            return _follow(messages, goal, console) if wait else 0
        except KeyboardInterrupt:
            console.print(GOAL_STAYS)
            raise


def _follow(messages: LatestMessages, goal: Goal, console: Console) -> int:
    """Waits until the goal is reached (returns 0), or refused or without progress for too long (returns 1)."""
    progress, waited_ns, previous_ns = _Progress(), 0, None
    with status_line("navigating", console) as show:
        while (status := _next_status(messages, console)) is not None:
            if status.goal_seq != goal.seq:
                cancelled = "the goal was cancelled, or the controller was restarted"
                raise UserError("the goal was replaced by another" if status.goal else cancelled)
            belief = messages.latest.get(BELIEF.name)
            if progress.is_made(status, belief if isinstance(belief, Belief) else None):
                waited_ns = 0
            elif previous_ns is not None:
                waited_ns += max(0, status.stamp_ns - previous_ns)
            previous_ns = status.stamp_ns
            what = f"{status.state}: {status.reason}" if status.reason else status.state
            if status.state == "reached" or status.refused:
                console.print(what)
                return 0 if status.state == "reached" else 1
            if waited_ns > PROGRESS_TIMEOUT_S * 1e9:
                console.print(f"{what}; no progress for {PROGRESS_TIMEOUT_S:g} s: {GOAL_STAYS}", soft_wrap=True)
                return 1
            to_go = f"{status.distance:.2f} m to go" if status.distance is not None else ""
            text = ", ".join(filter(None, (status.state, to_go, status.reason)))
            show(text, f"{status.state} {status.reason}".rstrip())
    raise UserError(f"the controller has published no status for {STATUS_TIMEOUT_S:g} s; {GOAL_STAYS}")


class _Progress:
    """Detects whether the robot comes nearer to its goal, or has moved far."""

    def __init__(self) -> None:
        self._least_distance = np.inf
        self._place: Array | None = None  # (2,) m in map, where the last progress was made

    def is_made(self, status: Status, belief: Belief | None) -> bool:
        """Whether there is progress since the last call that returned True."""
        if status.distance is None and status.state == "navigating":
            return True  # to a lift or in it, which may take long
        # In other states the pose may jump while the robot stands.
        place = belief.pose.array()[:2] if belief is not None and belief.state == "tracking" else None
        distance = np.inf if status.distance is None else status.distance
        nearer = distance < self._least_distance - MIN_APPROACH_M
        moved = place is not None and (self._place is None or np.hypot(*(place - self._place)) > MIN_MOTION_M)
        if nearer:
            self._least_distance = distance
        if (nearer or moved) and place is not None:
            self._place = place
        return bool(nearer or moved)


def _next_status(messages: LatestMessages, console: Console) -> Status | None:
    """Returns the next status, or None after a timeout.

    The timeout is long enough to restart the estimator meanwhile: without beliefs the controller publishes no status.
    """
    if (status := messages.wait_for(Status, lambda _: True, STATUS_WARNING_S)) is None:
        console.print(f"the controller publishes no status; waiting up to {STATUS_TIMEOUT_S:g} s for it")
        status = messages.wait_for(Status, lambda _: True, STATUS_TIMEOUT_S - STATUS_WARNING_S)
    return status


def _place(pose: Pose, floor: str) -> str:
    return f"({pose.x:g}, {pose.y:g})" + (f" on floor {floor!r}" if floor else "")


def teleport(link: Link, pose: Pose, console: Console, *, floor: str = "") -> None:
    """Moves the simulated robot to a pose in map, or in the frame of a floor.

    Raises UserError with the reason if the simulator refuses.
    """
    with session_bus(link) as bus:
        reply = bus.query(TELEPORT, PoseRequest(pose=pose, map_id=floor), Reply)
    if not reply.ok:
        raise UserError(f"refused: {reply.reason}")
    console.print(
        f"moved to {_place(pose, floor)}, {np.rad2deg(pose.yaw):g} deg; the estimator is not informed",
        soft_wrap=True,
    )


def list_topics(robot: str, console: Console) -> None:
    """Prints the tables of topics and queryables."""
    table = Table(title="topics", title_justify="left")
    for column in ("key", "message", "Hz", "publisher", "receivers keep", "recorded", "about"):
        table.add_column(column, no_wrap=column == "key")
    for topic in TOPICS:
        table.add_row(
            topic.key(robot, "SERVICE"),
            topic.message.__name__,
            f"{topic.rate:g}" if topic.rate else "-",
            topic.publisher,
            topic.queue,
            "yes" if topic.recorded else "no",
            topic.about,
        )
    console.print(table)
    table = Table(title="queryables", title_justify="left")
    for column in ("key", "request", "reply", "server", "about"):
        table.add_column(column, no_wrap=column == "key")
    for query in QUERIES:
        names = (query.request.__name__, query.reply.__name__)
        table.add_row(query.key(robot, "SERVICE"), *names, query.server, query.about)
    console.print(table)


def measure_rates(link: Link, topics: tuple[Topic, ...], seconds: float) -> dict[str, list[int]]:
    """Receives ``topics`` for ``seconds`` s; returns the arrival times (ns of monotonic time) by key.

    Raises UserError if no message comes.
    """
    with session_bus(link) as bus:
        inbox, times = Inbox(), defaultdict(list)
        for topic in topics:
            bus.subscribe(topic, inbox, keep_all=True)
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            sample = inbox.get(left)
            if isinstance(sample, Sample):
                times[sample.key].append(sample.received_ns)
        if not times:
            what = f"on {topics[0].key(link.robot)}" if len(topics) == 1 else f"of robot {link.robot!r}"
            raise UserError(f"no message {what} within {seconds:g} s: `presage top` shows which services run")
        return dict(times)


def show_rates(link: Link, name: str | None, seconds: float, console: Console) -> None:
    """Prints measured and nominal rates of a topic, or of all if ``name`` is None."""
    topics = (topic_named(name),) if name else TOPICS
    with console.status(f"measuring for {seconds:g} s"):
        times = measure_rates(link, topics, seconds)
    table = Table()
    for column in ("key", "messages", "Hz", "nominal", "period ms: median", "longest"):
        table.add_column(column, justify="left" if column == "key" else "right")
    for topic in topics:
        keys = [key for key in sorted(times) if key.split("/")[2] == topic.name]
        for key in keys or [topic.key(link.robot)]:
            stamps = np.array(times.get(key, []))
            periods = np.diff(stamps) / 1e6
            row = (
                [f"{1000 / periods.mean():.2f}", f"{np.median(periods):.1f}", f"{periods.max():.1f}"]
                if len(periods)
                else ["-"] * 3
            )
            table.add_row(key, str(len(stamps)), row[0], f"{topic.rate:g}" if topic.rate else "-", *row[1:])
    console.print(table)


def to_plain_values(message: Message, *, full: bool) -> dict[str, Any]:
    """A message as values that JSON can hold; long arrays and texts are shortened to both ends unless ``full``."""

    def convert(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            # Significant digits instead of decimals, because covariances are of the order of 1e-6.
            numbers = [float(f"{v:.6g}") if np.isfinite(v) else str(v) for v in value.astype(float).ravel().tolist()]
            if full or len(numbers) <= 9:
                return numbers
            return [*numbers[:3], f"... {len(numbers)} ...", *numbers[-3:]]
        if isinstance(value, BaseModel):
            return {name: convert(getattr(value, name)) for name in type(value).model_fields}
        if isinstance(value, str) and len(value) > MAX_TEXT and not full:
            return f"{value[:10]} ... {len(value)} ... {value[-10:]}"
        return [convert(item) for item in value] if isinstance(value, list) else value

    result: dict[str, Any] = convert(message)
    return result


def echo(link: Link, name: str, count: int, console: Console, *, full: bool) -> int:
    """Prints ``count`` messages of a topic (0: until Ctrl-C), one JSON line each; returns 0.

    Raises UserError if no first message comes within 5 s.
    """
    topic, printed = topic_named(name), 0
    with session_bus(link) as bus:
        inbox = Inbox()
        bus.subscribe(topic, inbox, keep_all=True)
        while not count or printed < count:
            sample = inbox.get(5.0)
            if not isinstance(sample, Sample):
                if printed == 0:
                    raise UserError(
                        f"no message on {topic.key(link.robot)} within 5 s: is the {topic.publisher} running?"
                    )
                continue
            printed += 1
            try:
                line = json.dumps(to_plain_values(topic.message.decode(sample.payload), full=full))
            except DecodeError as error:
                line = f"undecodable, {len(sample.payload)} bytes: {error}"
            console.print(line, markup=False, highlight=False, soft_wrap=True)
    return 0


def relocalise(link: Link, pose: Pose | None, console: Console, *, heading_known: bool = True, floor: str = "") -> int:
    """Resets the estimator's belief, and prints the state and pose that it finds; returns 0 if it is tracking, else 1.

    ``pose`` is in map, or in the frame of a floor. Raises UserError if the estimator refuses, or publishes no belief.
    """
    with session_bus(link) as bus:
        reply = bus.query(LOCALISE, LocaliseRequest(pose=pose, heading_known=heading_known, map_id=floor), Reply)
        if not reply.ok:
            raise UserError(f"refused: {reply.reason}")
        heading = f", {np.rad2deg(pose.yaw):g} deg" if pose and heading_known else ""
        console.print(f"localising again from {_place(pose, floor)}{heading}" if pose else "localising again")
        messages = LatestMessages(bus, BELIEF)  # only now, so that no belief is from before
        with console.status("waiting for state tracking"):
            messages.wait_for(Belief, lambda belief: belief.state == "tracking", LOCALISATION_TIMEOUT_S)
        belief = messages.latest.get(BELIEF.name)
        if not isinstance(belief, Belief):
            raise UserError(f"no belief came within {LOCALISATION_TIMEOUT_S:g} s: `presage doctor` finds the cause")
    x, y, yaw = belief.pose.x, belief.pose.y, np.rad2deg(belief.pose.yaw)
    late = "" if belief.state == "tracking" else f" after {LOCALISATION_TIMEOUT_S:g} s, most probably"
    console.print(f"{belief.state}{late} at ({x:.3f}, {y:.3f}), {yaw:.1f} deg in the map", highlight=False)
    if pose and heading_known and belief.estimator == "paper":
        console.print(f"preset paper knows only this heading; the {np.rad2deg(pose.yaw):g} deg given were not used")
    return 0 if belief.state == "tracking" else 1


def save_map(link: Link, name: str, console: Console) -> None:
    """Has the mapper write its map into files; raises UserError with the reason if it cannot."""
    with session_bus(link) as bus:
        # A session that has just opened does not know the services yet.
        if not wait_until(lambda: SAVE_MAP.server in bus.alive(), DISCOVERY_TIMEOUT_S):
            session = session_of(bus.robot, ",".join(link.connect))
            command = "" if session is None else session.start_command(SAVE_MAP.server, bus.robot)
            advice = (
                f"it ended; start it with: {command}" if command else "start one with `presage up --mapping`, and drive"
            )
            raise UserError(f"no mapper is running: {advice}")
        reply = bus.query(SAVE_MAP, SaveMapRequest(name=name), SaveMapReply, SAVE_TIMEOUT_S)
    if not reply.ok:
        raise UserError(f"not saved: {reply.reason}")
    console.print(f"saved: {reply.file}. Before `presage up --world`, learn its model:", soft_wrap=True)
    console.print(f"presage train --world {reply.file}", soft_wrap=True)


def save_model(link: Link, name: str, console: Console) -> None:
    """Has the estimator write what it learned while driving; raises UserError with the reason if it cannot."""
    with session_bus(link) as bus:
        reply = bus.query(SAVE_MODEL, SaveModelRequest(name=name), SaveModelReply, SAVE_TIMEOUT_S)
    if not reply.ok:
        raise UserError(f"not saved: {reply.reason}")
    console.print(f"saved version {reply.version}: {reply.file}. Use it with the same world:", soft_wrap=True)
    console.print(f"presage up --world ... --model {reply.file}", soft_wrap=True)
