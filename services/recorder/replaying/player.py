"""Position, rate and pause of a replay.

Positions are seconds from the recording's beginning; the wall's clock comes in as ``now``, s, and is never read here.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping

from common.errors import UserError
from common.messages.requests import PlayerReply, PlayerRequest
from common.messages.topics import CMD_VEL, HEALTH, ROOT, TOPICS, Topic

MAX_LAG_S = 1.0  # s behind its own time, beyond which a replay goes on from where it is and does not hurry
MAX_STEPS = 10_000
LOOP_GAP_S = 0.1  # s between the end of a loop and its beginning anew


class Player:
    """Where a replay of ``begin`` to ``end`` stands; ``rate`` times the original timing, 0 as fast as it goes."""

    def __init__(self, begin: float, end: float, rate: float = 1.0, *, loop: bool = False, now: float = 0.0) -> None:
        """Running, at ``begin``."""
        self.begin, self.end, self.loop = begin, end, loop
        self.rate = 0.0 if rate <= 0 or math.isinf(rate) else rate
        self.paused = False
        self._position, self._since = begin, now
        self._steps = 0  # asked for and not yet done
        self._seek_target: float | None = None

    def position(self, now: float) -> float:
        """By the clock; as fast as it goes, and paused, that of the last message."""
        if self.paused or self.rate == 0:
            return self._position
        return min(self.end, self._position + max(0.0, now - self._since) * self.rate)

    def wait(self, at: float, now: float) -> float:
        """Seconds until a message at ``at`` is due: 0 is now, infinity while paused."""
        if self._steps:
            return 0.0
        if self.paused:
            return math.inf
        if self.rate == 0:
            return 0.0
        return max(0.0, (at - self._position) / self.rate - (now - self._since))

    def sent(self, at: float, now: float, *, whole: bool) -> None:
        """A message at ``at`` went out; ``whole``: it completes a step."""
        ahead = self.position(now) - at
        if self.paused or self.rate == 0 or ahead > MAX_LAG_S * self.rate:
            self._anchor(at, now)
        if self._steps and whole:
            self._steps -= 1

    def handle(self, request: PlayerRequest, now: float) -> PlayerReply:
        """Do what is asked; the state then, or why not."""
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
        """For who asks; ``duration_s`` is where the replay ends."""
        return PlayerReply(
            paused=self.paused, position_s=self.position(now), duration_s=self.end, rate=self.rate, loop=self.loop
        )

    def seek(self, position: float, now: float) -> None:
        """To the place, or the nearest end; what is read must begin there: see `jump`."""
        self._seek_target = min(max(position, self.begin), self.end)
        self._anchor(self._seek_target, now)
        self._steps = 0

    def restart(self, now: float) -> None:
        """From the beginning, a moment later."""
        self.seek(self.begin, now + (LOOP_GAP_S if self.rate else 0.0))

    def finish(self, now: float) -> None:
        """At the end, paused, whatever was asked for: nothing comes after it."""
        self._anchor(self.end, now)
        self.paused, self._steps = True, 0

    def take_seek_target(self) -> float | None:
        """Where to read from now on, once after each seek."""
        jump, self._seek_target = self._seek_target, None
        return jump

    @property
    def seek_pending(self) -> bool:
        """Whether `jump` has something to say."""
        return self._seek_target is not None

    def _anchor(self, position: float, now: float) -> None:
        self._position, self._since = position, now


def span(duration: float, start: float | None, end: float | None) -> tuple[float, float]:
    """Begin and end in s; a negative ``end`` counts from the recording's end. UserError where nothing lies between."""
    first = start or 0.0
    last = duration if end is None else duration + end if end < 0 else min(end, duration)
    if not 0 <= first <= duration:
        raise UserError(f"--start {first:g}: the recording lasts {duration:.2f} s")
    if last < first:
        raise UserError(f"--start {first:g} --end {end:g}: nothing lies between in a recording of {duration:.2f} s")
    return first, last


def select_topics(
    there: Mapping[str, Topic], only: Collection[str] | None, leave_out: Collection[str] | None = None
) -> dict[str, Topic]:
    """Keys of the topics named, or of all but health, a live service's pulse, less those to leave out.

    Raises UserError for a name that the recording (``only``) or the table (``leave_out``) does not have.
    """
    names = {topic.name for topic in there.values()}
    if only is not None and (unknown := set(only) - names):
        raise UserError(
            f"the recording has no {', '.join(sorted(unknown))}; it has {', '.join(sorted(names)) or 'nothing'}"
        )
    known = {topic.name for topic in TOPICS}
    if unknown := set(leave_out or ()) - known:
        raise UserError(f"no topic {', '.join(sorted(unknown))}: choose from {', '.join(sorted(known))}")
    wanted = (set(only) if only is not None else names - {HEALTH.name}) - set(leave_out or ())
    return {key: topic for key, topic in there.items() if topic.name in wanted}


def key_for_robot(key: str, robot: str) -> str:
    """The key of another robot; empty: as it is."""
    root, was, rest = key.split("/", 2)
    return f"{root}/{robot or was}/{rest}"


def robot_of(key: str) -> str:
    """Whose key it is."""
    return key.split("/")[1]


def find_conflicts(keys: Mapping[str, Topic], alive: Mapping[str, Collection[str]]) -> str:
    """Why these keys should not be published beside the services alive, by robot; empty where nothing speaks against.

    Topics published at need (a goal) belong to nobody. Velocity commands also meet those who obey them.
    """
    found: dict[tuple[str, str], list[str]] = {}
    driven: list[str] = []
    for key, topic in sorted(keys.items()):
        robot = robot_of(key)
        services = set(alive.get(robot, ()))
        publisher = key.rsplit("/", 1)[-1] if topic.per_service else topic.publisher
        for service in {publisher, "replay"} & services if topic.rate else ():
            found.setdefault((robot, service), []).append(key)
        if topic is CMD_VEL and "simulator" in services:
            driven.append(key)
    reasons = [
        f"the {service} of {robot!r} is alive and publishes {', '.join(held)}"
        for (robot, service), held in sorted(found.items())
    ]
    reasons += [f"{key} would drive the live simulator" for key in driven]
    if not reasons:
        return ""
    names = sorted({keys[key].name for held in found.values() for key in held} | {CMD_VEL.name for _ in driven})
    return (
        f"not beside a live publisher: {'; '.join(reasons)}; leave them out with --except {','.join(names)}, use other "
        "keys with --robot NAME, or insist with --force"
    )


def robots_of_keys(keys: Iterable[str]) -> list[str]:
    """Whose keys these are, each once, in order."""
    return list(dict.fromkeys(robot_of(key) for key in keys if key.startswith(ROOT + "/")))
