"""Which nodes and topics exist on the ROS side."""

from __future__ import annotations

from services.bridge_ros2.keys import Endpoint, Names, read_token
from services.bridge_ros2.ros_types import NO_HASH, TWIST, TWIST_STAMPED, type_hash

MAX_NAMES_SHOWN = 4  # names in one line


class Graph:
    """Publishers and subscriptions by their tokens; a zenoh thread tells, a loop asks."""

    def __init__(self, names: Names | None = None) -> None:
        """Nobody has been seen; ``names``: how we call topics."""
        self._names = names or Names()
        self._tokens: dict[str, Endpoint] = {}

    def change(self, token: str, *, there: bool) -> None:
        """A token has come, or gone."""
        if there and (endpoint := read_token(token)) is not None:
            self._tokens[token] = endpoint
        else:
            self._tokens.pop(token, None)

    def endpoints(self) -> list[Endpoint]:
        """All of our flavour and domain, ordered by name."""
        return [each for each in self._all() if self._names.ours(each)]

    def other_endpoints(self) -> list[Endpoint]:
        """All others."""
        return [each for each in self._all() if not self._names.ours(each)]

    def _all(self) -> list[Endpoint]:
        return sorted(self._tokens.copy().values(), key=lambda each: (each.topic, each.kind, each.node))

    def distro_mismatch(self, topic: str) -> str:
        """Which ``--distro`` fits, where ours does not by the hashes of types; those who publish ``topic`` decide."""
        if self._names.flavor == "ros2dds":
            return ""
        there = self.endpoints()
        there = [each for each in there if each.publishes and each.topic == topic] or there
        hashes = {each.hash != NO_HASH for each in there}
        if hashes != {not self._names.hashes}:  # nobody, ours, or some of either
            return ""
        who = _nodes(there)
        if self._names.hashes:
            return f"the types of {who} have no hashes, as Humble's: --distro humble, or it will not hear us"
        return f"the types of {who} have hashes, as from Iron on: --distro jazzy, or it will not hear us"

    def why_silent(self, topic: str, kind: str, option: str, *, no_endpoints: str) -> str:
        """Why nothing may come on ``topic``; ``option`` names another one, ``no_endpoints`` is said where none is seen."""
        there = self.endpoints()
        publishers = [each for each in there if each.publishes]
        known = any(each.kind == kind for each in publishers)
        if not there or (not known and any(each.publishes and each.kind == kind for each in self.other_endpoints())):
            return no_endpoints
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
            return f"nobody publishes it; {kind} is on {join_names(others)}: {option}"
        return (
            f"nobody publishes it, nor any other {kind}; there are {join_names(sorted({e.topic for e in publishers}))}"
        )

    def topics_of(self, kind: str) -> list[str]:
        """On which a type is published."""
        return sorted({each.topic for each in self.endpoints() if each.publishes and each.kind == kind})

    def publishers(self, topic: str) -> str:
        """Who publishes a topic beside us; empty: nobody."""
        there = [each for each in self.endpoints() if each.publishes and each.topic == topic]
        return _nodes(there) if there else ""

    def expected_twist_type(self, topic: str) -> str:
        """The type that subscriptions on the command topic have; empty where there is none, or both are there."""
        kinds = {e.kind for e in self.endpoints() if not e.publishes and e.topic == topic}
        found = kinds & {TWIST, TWIST_STAMPED}
        return found.pop() if len(found) == 1 else ""


def _nodes(endpoints: list[Endpoint]) -> str:
    return join_names(sorted({each.node for each in endpoints} - {""})) or "somebody"


def join_names(names: list[str]) -> str:
    """The first of them, and how many more, for one line."""
    more = len(names) - MAX_NAMES_SHOWN
    return ", ".join(names[:MAX_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
