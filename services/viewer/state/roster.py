"""Tracks which services of which robots are alive."""

from __future__ import annotations

MAX_ROBOTS = 200  # so that invented names cannot fill the memory


class Roster:
    """The live services of each robot, from their liveliness tokens."""

    def __init__(self, robot: str) -> None:
        """``robot`` is always listed, even without live services."""
        self.robot = robot
        self._alive: dict[str, frozenset[str]] = {}  # replaced as a whole, because other threads read it

    def change(self, robot: str, service: str, alive: bool) -> None:  # noqa: FBT001 - called as a callback
        """Records that a service started or ended."""
        services = self._alive.get(robot, frozenset())
        services = services | {service} if alive else services - {service}
        others = {name: known for name, known in self._alive.items() if name != robot}
        self._alive = {**others, robot: services} if services and len(others) < MAX_ROBOTS else others

    def services(self, robot: str) -> frozenset[str]:
        """Live services of a robot."""
        return self._alive.get(robot, frozenset())

    def robots(self) -> list[str]:
        """The viewer's own robot, then other robots with live services besides viewer and recorder."""
        others = {name for name, services in self._alive.items() if services - {"viewer", "recorder"}}
        return [self.robot, *sorted(others - {self.robot})]
