"""Who is there in the ROS graph, and what that says of messages that do not come. Pure."""

from __future__ import annotations

from services.bridge_ros2.keys import Endpoint, read_token
from services.bridge_ros2.ros_types import NO_HASH, TWIST, TWIST_STAMPED, type_hash

SHOWN = 4  # names in one line


class Graph:
    """Publishers and subscriptions by their tokens; a zenoh thread tells, a loop asks."""

    def __init__(self) -> None:
        """Nobody has been seen."""
        self._tokens: dict[str, Endpoint] = {}

    def change(self, token: str, *, there: bool) -> None:
        """A token has come, or gone."""
        if there and (endpoint := read_token(token)) is not None:
            self._tokens[token] = endpoint
        else:
            self._tokens.pop(token, None)

    def endpoints(self) -> list[Endpoint]:
        """All, ordered by name."""
        return sorted(self._tokens.copy().values(), key=lambda each: (each.topic, each.kind, each.node))

    def why_silent(self, topic: str, kind: str, option: str, *, nobody: str) -> str:
        """Why nothing may come on ``topic``; ``option`` names another one, ``nobody`` is said where none is seen."""
        there = self.endpoints()
        if not there:
            return nobody
        publishers = [each for each in there if each.publishes]
        here = [each for each in publishers if each.topic == topic]
        of_kind = [each for each in here if each.kind == kind]
        foreign = [each for each in of_kind if each.hash not in ("", NO_HASH, type_hash(kind))]
        if foreign:
            return (
                f"{_nodes(foreign)} publishes it with the type hash {foreign[0].hash}, the {kind} known here has "
                f"{type_hash(kind)}: another definition of the type"
            )
        if of_kind:
            return f"{_nodes(of_kind)} publishes it, but nothing arrives: is it paused, or cut off from the router?"
        if here:
            return f"it is of type {here[0].kind}, not {kind}"
        if others := sorted({each.topic for each in publishers if each.kind == kind}):
            return f"nobody publishes it; {kind} is on {_some(others)}: {option}"
        return f"nobody publishes it, nor any other {kind}; there are {_some(sorted({e.topic for e in publishers}))}"

    def topics_of(self, kind: str) -> list[str]:
        """On which a type is published."""
        return sorted({each.topic for each in self.endpoints() if each.publishes and each.kind == kind})

    def twist_wanted(self, topic: str) -> str:
        """The type that subscriptions on the command topic have; empty where there is none, or both are there."""
        kinds = {e.kind for e in self.endpoints() if not e.publishes and e.topic == topic}
        found = kinds & {TWIST, TWIST_STAMPED}
        return found.pop() if len(found) == 1 else ""


def _nodes(endpoints: list[Endpoint]) -> str:
    return _some(sorted({each.node for each in endpoints} - {""})) or "somebody"


def _some(names: list[str]) -> str:
    more = len(names) - SHOWN
    return ", ".join(names[:SHOWN]) + (f" and {more} more" if more > 0 else "")
