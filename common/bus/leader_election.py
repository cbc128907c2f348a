"""Elects one active instance of a service."""

from __future__ import annotations

from collections.abc import Callable

from common.bus.bus import Bus, wait_until
from common.bus.instances import Instances, describe_instance
from common.errors import UserError
from common.log import Logger

LINK_TIMEOUT_S = 0.5  # for the first link, before a service looks for other instances


class LeaderElection:
    """Makes this instance active while no other is, and stand by otherwise."""

    def __init__(self, bus: Bus, service: str, log: Logger, wake: Callable[[], None]) -> None:
        """Takes part in the election for ``service``; ``wake`` is called from another thread when instances change."""
        self._bus, self._service, self._log, self._wake = bus, service, log, wake
        self._others: Instances | None = None  # known since the first attempt to become active
        self._end_standby: Callable[[], None] | None = None  # set while this instance stands by

    def try_activate(self) -> bool:
        """Becomes active, or stands by if another instance is active; returns whether this instance is active now."""
        if self._others is None:
            wait_until(self._bus.linked, LINK_TIMEOUT_S)  # without a link, other instances cannot be found
            self._others = self._bus.instances(self._service, self._wake)
        if not self._others.may_lead():
            if self._end_standby is None:
                self._end_standby = self._bus.stand_by(self._service)
                self._log.warning(
                    "standing by: another instance is active; this one takes over when it is gone",
                    leads=[describe_instance(name) for name in self._others.leaders()],
                )
            return False
        if self._end_standby is not None:
            self._end_standby()
            self._end_standby = None
            self._log.warning("taking over: the active instance is gone")
        return True

    def refresh(self) -> None:
        """Queries the active instances again; call it now and then, because a notification may get lost."""
        if self._others is not None:
            self._others.refresh()

    def check_oldest(self) -> None:
        """Raises UserError if an older instance is active too, as after two parts of a network were joined."""
        if self._others is not None and self._others.must_yield():
            older = describe_instance(self._others.leaders()[0])
            raise UserError(
                f"another {self._service} of {self._bus.robot!r}, {older}, was started before this one and is active, "
                "so this one ends. Start it again to have it stand by"
            )
