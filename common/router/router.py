"""Runs the router until a signal ends it.

Services discover each other through the router; after that they exchange data directly, even if the router ends. In
secure mode all data flows through the router, which decides what each session may send.
"""

from __future__ import annotations

import signal
import sys
import time
from contextlib import ExitStack
from typing import Annotated, ClassVar

from pydantic import Field
from pydantic_settings import CliSuppress

from common.bus.bus import DEFAULT_ENDPOINT, Link, open_bus
from common.errors import UserError
from common.log import Logger, begin_logging, logger, report_failure, set_up_logging
from common.names import split_names
from common.router.refusals import LOG_FILTER, Refusals, capture_zenoh_log
from common.runtime.config import ServiceSettings, load_settings

STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT)
STOP_PERIOD_S = 0.1  # of looking for a signal


class RouterSettings(ServiceSettings):
    """Zenoh router through which services discover each other.

    PRESAGE_CONNECT and PRESAGE_LISTEN apply to services and are ignored here, because with them a router on the
    same machine would connect to itself. Use PRESAGE_ROUTER_CONNECT and PRESAGE_ROUTER_LISTEN instead.

    Examples:
      python -m common.router                                          for services on this machine
      python -m common.router --listen tls/0.0.0.0:7447 --security DIR for other machines with credentials
      python -m common.router --listen tcp/0.0.0.0:7447 --insecure     for all machines on a private network
      python -m common.router --connect tcp/192.168.0.10:7447          connected to a router on another machine

    """

    service: ClassVar[str] = "router"
    program: ClassVar[str] = "python -m common.router"
    private: ClassVar[frozenset[str]] = frozenset({"connect", "listen"})

    robot: CliSuppress[str] = "robot"  # unused: a router serves all robots
    connect: Annotated[str, Field(description="other routers to connect to, comma-separated")] = ""
    listen: Annotated[str, Field(min_length=1, description="endpoints to listen on, comma-separated")] = (
        DEFAULT_ENDPOINT
    )

    def link(self) -> Link:
        """Parameters of a session in router mode; raises UserError if the credentials are not a router's."""
        connect, listen = tuple(split_names(self.connect)), tuple(split_names(self.listen))
        security = self.credentials()
        if security is not None and security.member.role != self.service:
            raise UserError(
                f"{security.folder}: role {security.member.role!r} cannot be used by a router, only {self.service!r}"
            )
        return Link(
            self.robot,
            connect,
            listen,
            router=True,
            security=security,
            insecure=self.insecure,
        )


def main(argv: list[str] | None = None) -> None:
    """Runs a router until SIGTERM or Ctrl-C.

    Exits with status 2 and a one-line message if the settings or endpoints cannot be used.
    """
    received: list[int] = []  # signals, also those that arrive before the router listens
    for number in STOP_SIGNALS:
        signal.signal(number, lambda number, _frame: received.append(number))
    begin_logging(RouterSettings.service, argv)
    try:
        settings = load_settings(RouterSettings, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json, service=RouterSettings.service)
        log = logger(RouterSettings.service)
        route(settings.link(), log, received, settings.metrics)
    except UserError as error:
        report_failure(RouterSettings.service, error)
        sys.exit(2)


def route(link: Link, log: Logger, received: list[int], metrics: str = "") -> None:
    """Runs a router until ``received`` has a signal; ``metrics`` is the address for metrics, or empty for none."""
    refusals, facts = Refusals(log), {}
    with ExitStack() as stack:
        if link.security is None:
            bus = stack.enter_context(open_bus(link))
        else:
            stack.enter_context(capture_zenoh_log(refusals))
            bus = stack.enter_context(open_bus(link, log_filter=LOG_FILTER))
            facts["members"] = [member.name for member in link.security.members]
        if metrics:
            from common.router.metrics import router_metrics
            from common.runtime.metrics_server import serve_registry

            log.info("metrics", address=stack.enter_context(serve_registry(router_metrics(bus), metrics)))
        log.info("router listens", endpoints=", ".join(link.listen), **facts)
        while not received:  # Windows has no sigwait
            time.sleep(STOP_PERIOD_S)
    log.info("ended", **({"refused": dict(refusals.counts)} if link.security is not None else {}))


if __name__ == "__main__":
    main()
