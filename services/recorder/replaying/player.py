"""Position, rate and pause of a replay.

Positions are seconds since the beginning of the recording. The current time is passed in as ``now`` in s; this module
reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping

from common.errors import UserError
from common.messages.requests import PlayerReply, PlayerRequest
from common.messages.topics import CMD_VEL, DRIVE, GOAL, HEALTH, ROOT, TOPICS, Topic
from common.runtime.service_monitor import SUBSTITUTES

MAX_LAG_S = 1.0  # a replay that lags further behind continues from its position instead of catching up
MAX_STEPS = 10_000  # in one request
LOOP_GAP_S = 0.1  # pause between the end of a loop and its next pass
# Topics that make a robot move, and the services that execute them
EXECUTED_BY = {
    CMD_VEL: frozenset({"simulator", SUBSTITUTES["simulator"]}),
    GOAL: frozenset({"controller"}),
    DRIVE: frozenset({"controller"}),
}


class Player:
    """Position of a replay between ``begin`` and ``end``. ``rate`` multiplies the speed; 0: as fast as possible."""

    def __init__(self, begin: float, end: float, rate: float = 1.0, *, loop: bool = False, now: float = 0.0) -> None:
        """Starts at ``begin``, not paused."""
        self.begin, self.end, self.loop = begin, end, loop
        self.rate = 0.0 if rate <= 0 or math.isinf(rate) else rate
        self.paused = False
        self._position, self._since = begin, now
        self._steps = 0  # requested but not yet executed
        self._seek_target: float | None = None

    def position(self, now: float) -> float:
        """Position in s. While paused or with rate 0, the position of the last message."""
        if self.paused or self.rate == 0:
            return self._position
        return min(self.end, self._position + max(0.0, now - self._since) * self.rate)

    def time_until(self, position: float, now: float) -> float:
        """Seconds until a message at ``position`` is due: 0 if it is due now, infinity while paused."""
        if self._steps:
            return 0.0
        if self.paused:
            return math.inf
        if self.rate == 0:
            return 0.0
        return max(0.0, (position - self._position) / self.rate - (now - self._since))

    def mark_sent(self, position: float, now: float, *, completes_step: bool) -> None:
        """Records that the message at ``position`` was published. ``completes_step``: it is the last one of a step."""
        ahead = self.position(now) - position
        if self.paused or self.rate == 0 or ahead > MAX_LAG_S * self.rate:
            self._anchor(position, now)
        if self._steps and completes_step:
            self._steps -= 1

    def handle(self, request: PlayerRequest, now: float) -> PlayerReply:
        """Executes a request. Returns the new state, or a refusal with its reason."""
        if request.action in ("pause", "step"):
            self._anchor(self.position(now), now)
            self.paused = True
            self._steps += max(1, round(min(request.value, MAX_STEPS))) if request.action == "step" else 0
        elif request.action == "resume":
            self._anchor(self.position(now), now)
            self.paused, self._steps = False, 0
        elif request.action == "seek":
            self.seek(request.value, now)
        elif request.action == "rate":
            if request.value < 0:
                return self.state(now).model_copy(update={"ok": False, "reason": "a rate is 0 or more"})
            self._anchor(self.position(now), now)
            self.rate = request.value
        return self.state(now)

    def state(self, now: float) -> PlayerReply:
        """State as a reply. ``duration_s`` is the position at which the replay ends."""
        return PlayerReply(
            paused=self.paused, position_s=self.position(now), duration_s=self.end, rate=self.rate, loop=self.loop
        )

    def seek(self, position: float, now: float) -> None:
        """Moves to a position, clamped to begin and end. The reader gets it from `take_seek_target`."""
        self._seek_target = min(max(position, self.begin), self.end)
        self._anchor(self._seek_target, now)
        self._steps = 0

    def restart(self, now: float) -> None:
        """Seeks to the beginning, after a short gap."""
        self.seek(self.begin, now + (LOOP_GAP_S if self.rate else 0.0))

    def finish(self, now: float) -> None:
        """Pauses at the end and drops requested steps, because no message follows."""
        self._anchor(self.end, now)
        self.paused, self._steps = True, 0

    def take_seek_target(self) -> float | None:
        """Returns the position to read from, once after each seek, else None."""
        target, self._seek_target = self._seek_target, None
        return target

    @property
    def seek_pending(self) -> bool:
        """Whether `take_seek_target` would return a position."""
        return self._seek_target is not None

    def _anchor(self, position: float, now: float) -> None:
        self._position, self._since = position, now


def span(duration: float, start: float | None, end: float | None) -> tuple[float, float]:
    """Begin and end in s. A negative ``end`` counts from the recording's end; raises UserError if nothing is left."""
    first = start or 0.0
    last = duration if end is None else duration + end if end < 0 else min(end, duration)
    if not 0 <= first <= duration:
        raise UserError(f"--start {first:g}: the recording lasts {duration:.2f} s")
    if last < first:
        raise UserError(f"--start {first:g} --end {end:g}: nothing lies between in a recording of {duration:.2f} s")
    return first, last


def select_topics(
    recorded: Mapping[str, Topic], only: Collection[str] | None, leave_out: Collection[str] | None = None
) -> dict[str, Topic]:
    """Keys to replay, with their topics.

    ``only`` defaults to all topics except health, which only live services should publish. ``leave_out`` is removed
    from it. Raises UserError for a name in ``only`` that the recording does not have, or in ``leave_out`` that the
    table of topics does not have.
    """
    names = {topic.name for topic in recorded.values()}
    if only is not None and (unknown := set(only) - names):
        raise UserError(
            f"the recording has no {', '.join(sorted(unknown))}; it has {', '.join(sorted(names)) or 'nothing'}"
        )
    known = {topic.name for topic in TOPICS}
    if unknown := set(leave_out or ()) - known:
        raise UserError(f"no topic {', '.join(sorted(unknown))}: choose from {', '.join(sorted(known))}")
    wanted = (set(only) if only is not None else names - {HEALTH.name}) - set(leave_out or ())
    return {key: topic for key, topic in recorded.items() if topic.name in wanted}


def key_for_robot(key: str, robot: str) -> str:
    """The same key for another robot; unchanged if ``robot`` is empty."""
    root, recorded_robot, rest = key.split("/", 2)
    return f"{root}/{robot or recorded_robot}/{rest}"


def robot_of(key: str) -> str:
    """Name of the robot in a key."""
    return key.split("/")[1]


def find_conflicts(keys: Mapping[str, Topic], alive: Mapping[str, Collection[str]]) -> str:
    """Explains which live services (``alive``, by robot) publish the same keys. Returns an empty string if none do.

    Topics without a rate, such as `plan`, may have several publishers. What makes a live robot move conflicts, too:
    velocity commands if there is a simulator or a bridge, goals and manual velocities if there is a controller.
    """
    found: dict[tuple[str, str], list[str]] = {}
    driven: list[str] = []
    for key, topic in sorted(keys.items()):
        robot = robot_of(key)
        services = set(alive.get(robot, ()))
        publisher = key.rsplit("/", 1)[-1] if topic.per_service else topic.publisher
        publishers = {publisher, SUBSTITUTES.get(publisher, publisher), "replay"}
        for service in publishers & services if topic.rate else ():
            found.setdefault((robot, service), []).append(key)
        if EXECUTED_BY.get(topic, frozenset()) & services:
            driven.append(key)
    reasons = [
        f"the {service} of {robot!r} is alive and publishes {', '.join(held)}"
        for (robot, service), held in sorted(found.items())
    ]
    reasons += [f"{key} would drive the live robot" for key in driven]
    if not reasons:
        return ""
    held_keys = {key for held in (*found.values(), driven) for key in held}
    leave_out = ""
    if any(topic.rate for key, topic in keys.items() if key not in held_keys):  # else nothing would be left to see
        leave_out = f", leave them out with --except {','.join(sorted({keys[key].name for key in held_keys}))}"
    return (
        f"conflict with a live publisher: {'; '.join(reasons)}; publish as another robot with --robot NAME"
        f"{leave_out}, or publish anyway with --force"
    )


def robots_of_keys(keys: Iterable[str]) -> list[str]:
    """Names of the robots in these keys, each once, in order."""
    return list(dict.fromkeys(robot_of(key) for key in keys if key.startswith(ROOT + "/")))
