"""Which services of which robots are alive."""

from __future__ import annotations

MAX_ROBOTS = 200  # robots; somebody may invent names


class Roster:
    """As the liveliness tokens say."""

    def __init__(self, robot: str) -> None:
        """``robot`` is listed whether or not anything of it is there."""
        self.robot = robot
        self._alive: dict[str, frozenset[str]] = {}  # replaced as a whole, never changed

    def change(self, robot: str, service: str, there: bool) -> None:  # noqa: FBT001
        """A service came or went."""
        services = self._alive.get(robot, frozenset())
        services = services | {service} if there else services - {service}
        others = {name: alive for name, alive in self._alive.items() if name != robot}
        self._alive = {**others, robot: services} if services and len(others) < MAX_ROBOTS else others

    def services(self, robot: str) -> frozenset[str]:
        """Those of a robot that are there."""
        return self._alive.get(robot, frozenset())

    def robots(self) -> list[str]:
        """Ours, then others that have more than somebody looking on."""
        others = {name for name, alive in self._alive.items() if alive - {"viewer", "recorder"}}
        return [self.robot, *sorted(others - {self.robot})]
