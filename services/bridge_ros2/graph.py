"""Tracks which nodes and topics exist on the ROS side."""

from __future__ import annotations

from services.bridge_ros2.keys import RosEndpoint, RosKeys, read_token
from services.bridge_ros2.ros_types import NO_HASH, TWIST, TWIST_STAMPED, type_hash

MAX_NAMES_SHOWN = 4  # in one line


class RosGraph:
    """Publishers and subscriptions on the ROS side, from their liveliness tokens.

    A zenoh thread calls `change`; the service's loop calls the other methods.
    """

    def __init__(self, keys: RosKeys | None = None) -> None:
        """``keys`` are the bridge's own keys on zenoh."""
        self._keys = keys or RosKeys()
        self._tokens: dict[str, RosEndpoint] = {}

    def change(self, token: str, *, alive: bool) -> None:
        """Records that a token appeared or disappeared."""
        if alive and (endpoint := read_token(token)) is not None:
            self._tokens[token] = endpoint
        else:
            self._tokens.pop(token, None)

    def endpoints(self) -> list[RosEndpoint]:
        """Endpoints of the bridge's flavour and domain, ordered by name."""
        return [each for each in self._all() if self._keys.matches(each)]

    def other_endpoints(self) -> list[RosEndpoint]:
        """Endpoints of another flavour or domain, ordered by name."""
        return [each for each in self._all() if not self._keys.matches(each)]

    def _all(self) -> list[RosEndpoint]:
        return sorted(self._tokens.copy().values(), key=lambda each: (each.topic, each.kind, each.node))

    def distro_mismatch(self, topic: str) -> str:
        """Explains which ``--distro`` is needed if the type hashes do not fit, else returns an empty string.

        The publishers of ``topic`` decide; without any, all endpoints do.
        """
        if self._keys.flavor == "ros2dds":
            return ""
        endpoints = self.endpoints()
        endpoints = [each for each in endpoints if each.publishes and each.topic == topic] or endpoints
        hashes = {each.hash != NO_HASH for each in endpoints}
        if hashes != {not self._keys.hashes}:  # no endpoints, matching ones, or a mixture
            return ""
        nodes, consequence = _nodes(endpoints), "or the robot will not receive what the bridge sends"
        if self._keys.hashes:
            return f"the message types of {nodes} have no hashes, as in Humble; set --distro humble, {consequence}"
        return f"the message types of {nodes} have hashes, as since Iron; set --distro jazzy, {consequence}"

    def explain_silence(self, topic: str, kind: str, option: str, *, no_endpoints: str) -> str:
        """Explains why no message of type ``kind`` arrives on ``topic``.

        ``option`` is the command-line option that selects another topic. Returns ``no_endpoints`` if there are no
        endpoints, or if only endpoints of another flavour or domain publish the type.
        """
        endpoints = self.endpoints()
        publishers = [each for each in endpoints if each.publishes]
        known = any(each.kind == kind for each in publishers)
        if not endpoints or (
            not known and any(each.publishes and each.kind == kind for each in self.other_endpoints())
        ):
            return no_endpoints
        on_topic = [each for each in publishers if each.topic == topic]
        of_kind = [each for each in on_topic if each.kind == kind]
        foreign = [each for each in of_kind if each.hash not in ("", NO_HASH, type_hash(kind))]
        if foreign:
            return (
                f"the {kind} of {_nodes(foreign)} has the type hash {foreign[0].hash}, not {type_hash(kind)}: "
                "the robot uses another definition of the type"
            )
        if of_kind:
            return (
                f"{_nodes(of_kind)} publishes it, but nothing arrives: is it paused, or disconnected from the router?"
            )
        if on_topic:
            return f"its type is {on_topic[0].kind}, not {kind}"
        if others := sorted({each.topic for each in publishers if each.kind == kind}):
            return f"no node publishes it; set {option}: {kind} is published on {join_names(others)}"
        topics = join_names(sorted({e.topic for e in publishers})) or "none"
        return f"no node publishes {kind}; the published topics are: {topics}"

    def topics_of(self, kind: str) -> list[str]:
        """Names of the topics on which a type is published."""
        return sorted({each.topic for each in self.endpoints() if each.publishes and each.kind == kind})

    def publishers(self, topic: str) -> str:
        """Names of other nodes that publish a topic; empty if there are none."""
        publishers = [each for each in self.endpoints() if each.publishes and each.topic == topic]
        return _nodes(publishers) if publishers else ""

    def expected_twist_type(self, topic: str) -> str:
        """Message type of the subscriptions to the command topic; empty if there are none, or if both types occur."""
        kinds = {e.kind for e in self.endpoints() if not e.publishes and e.topic == topic}
        found = kinds & {TWIST, TWIST_STAMPED}
        return found.pop() if len(found) == 1 else ""


def _nodes(endpoints: list[RosEndpoint]) -> str:
    return join_names(sorted({each.node for each in endpoints} - {""})) or "a node"


def join_names(names: list[str]) -> str:
    """The first names and the number of further ones, for one line."""
    more = len(names) - MAX_NAMES_SHOWN
    return ", ".join(names[:MAX_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
