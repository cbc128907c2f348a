"""Elects one active instance of a service."""

from __future__ import annotations

from collections.abc import Callable

from common.bus.bus import Bus, wait_until
from common.bus.instances import Instances, describe_instance
from common.errors import UserError
from common.log import Logger

LINKED_WITHIN = 0.5  # s that a service waits for its first link before it looks who else is there


class LeaderElection:
    """Waits for the lead, and gives it up to an elder."""

    def __init__(self, bus: Bus, service: str, log: Logger, wake: Callable[[], None]) -> None:
        """``wake`` is called from another thread when somebody came or went."""
        self._bus, self._service, self._log, self._wake = bus, service, log, wake
        self._others: Instances | None = None  # nobody has looked yet
        self._stands_by: Callable[[], None] | None = None  # ends it

    def takes(self) -> bool:
        """Whether this instance leads from now on; else it stands by, and is to ask again."""
        if self._others is None:
            wait_until(self._bus.linked, LINKED_WITHIN)  # who is linked to nobody hears of nobody
            self._others = self._bus.instances(self._service, self._wake)
        if not self._others.may_lead():
            if self._stands_by is None:
                self._stands_by = self._bus.stand_by(self._service)
                self._log.warning(
                    "standing by: another was there first; this one takes over when it is gone",
                    leads=[describe_instance(name) for name in self._others.leaders()],
                )
            return False
        if self._stands_by is not None:
            self._stands_by()
            self._stands_by = None
            self._log.warning("taking over: the one that led is gone")
        return True

    def look(self) -> None:
        """Ask who else leads: now and then, for a word of one who comes back may get lost."""
        if self._others is not None:
            self._others.look()

    def check(self) -> None:
        """Raises UserError where an elder instance leads as well: two halves of a network have met."""
        if self._others is not None and self._others.must_yield():
            raise UserError(
                f"another {self._service} of {self._bus.robot!r}, {describe_instance(self._others.leaders()[0])}, was started "
                f"before this one and leads: this one ends. Started again, it stands by"
            )
