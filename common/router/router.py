"""Runs the router until a signal ends it.

Data flows directly between services once they know each other through the router, and outlives it. In secure mode all
data flows through it, and it decides what each may send.
"""

from __future__ import annotations

import signal
import sys
from contextlib import ExitStack
from typing import Annotated, ClassVar

from pydantic import Field
from pydantic_settings import CliSuppress

from common.bus.bus import DEFAULT_ENDPOINT, Link, open_bus
from common.errors import UserError
from common.log import Logger, begin_logging, logger, report_failure, set_up_logging
from common.router.refusals import LOG_FILTER, Refusals, listening_to_zenoh
from common.runtime.config import ServiceSettings, load_settings, split_endpoints

ENDING = (signal.SIGTERM, signal.SIGINT)


class RouterSettings(ServiceSettings):
    """Zenoh router that services find one another through.

    PRESAGE_CONNECT and PRESAGE_LISTEN are meant for services and mean nothing here: a router beside them
    would connect to itself. Its own are PRESAGE_ROUTER_CONNECT and PRESAGE_ROUTER_LISTEN.

    Examples:
      python -m common.router                                          for services on this machine
      python -m common.router --listen tls/0.0.0.0:7447 --security DIR for other machines too: whom DIR names
      python -m common.router --listen tcp/0.0.0.0:7447 --insecure     for anybody on a network that is private
      python -m common.router --connect tcp/192.168.0.10:7447          joined to a router elsewhere

    """

    service: ClassVar[str] = "router"
    program: ClassVar[str] = "python -m common.router"
    private: ClassVar[frozenset[str]] = frozenset({"connect", "listen"})

    robot: CliSuppress[str] = "robot"  # a router serves all of them
    connect: Annotated[str, Field(description="other routers to join, comma-separated")] = ""
    listen: Annotated[str, Field(min_length=1, description="endpoints to listen on, comma-separated")] = (
        DEFAULT_ENDPOINT
    )

    def link(self) -> Link:
        """A session in router mode."""
        connect, listen = split_endpoints(self.connect), split_endpoints(self.listen)
        security = self.credentials()
        if security is not None and security.member.role != self.service:
            raise UserError(f"{security.folder}: role {security.member.role!r} cannot route: it takes {self.service!r}")
        return Link(
            self.robot, connect, listen, router=True, multicast=self.multicast, security=security,
            insecure=self.insecure,
        )  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Route until SIGTERM or Ctrl-C; status 0 then, 2 and one line where the endpoints cannot be used."""
    # Blocked from the first line on, so that a signal is kept until sigwait takes it, however early it comes.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    begin_logging(RouterSettings.service, argv)
    try:
        settings = load_settings(RouterSettings, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json, service=RouterSettings.service)
        log = logger(RouterSettings.service)
        route(settings.link(), log, settings.metrics)
    except UserError as error:
        report_failure(RouterSettings.service, error)
        sys.exit(2)


def route(link: Link, log: Logger, metrics: str = "") -> None:
    """Until a signal ends it; ``metrics``: where Prometheus may ask, empty: nowhere."""
    refusals, facts = Refusals(log), {}
    with ExitStack() as stack:
        if link.security is None:
            bus = stack.enter_context(open_bus(link))
        else:
            stack.enter_context(listening_to_zenoh(refusals))
            bus = stack.enter_context(open_bus(link, log_filter=LOG_FILTER))
            facts["lets_in"] = [member.name for member in link.security.members]
        if metrics:
            from common.router.metrics import RouterMetrics  # noqa: PLC0415
            from common.runtime.metrics_server import serve  # noqa: PLC0415

            log.info("metrics", address=stack.enter_context(serve(RouterMetrics(bus).registry, metrics)))
        log.info("router listens", endpoints=", ".join(link.listen), **facts)
        signal.sigwait(ENDING)
    log.info("ended", **({"refused": dict(refusals.counts)} if link.security is not None else {}))


if __name__ == "__main__":
    main()
