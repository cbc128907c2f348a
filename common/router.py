"""`python -m common.router`: the meeting point of sessions on several hosts, or of many on one; it keeps nothing.

Data flows directly between services once they know each other through the router, and outlives it.
"""

from __future__ import annotations

import signal
import sys
from contextlib import ExitStack
from typing import Annotated, ClassVar

from pydantic import Field
from pydantic_settings import CliSuppress

from common.bus import DEFAULT_ENDPOINT, Link, open_bus
from common.config import ServiceSettings, load_settings, split_endpoints
from common.errors import UserError
from common.log import begin_logging, logger, say_failure, set_up_logging

ENDING = (signal.SIGTERM, signal.SIGINT)


class RouterSettings(ServiceSettings):
    """Zenoh router that services find one another through.

    PRESAGE_CONNECT and PRESAGE_LISTEN are meant for services and mean nothing here: a router beside them
    would connect to itself. Its own are PRESAGE_ROUTER_CONNECT and PRESAGE_ROUTER_LISTEN.

    Examples:
      python -m common.router                                          for services on this machine
      python -m common.router --listen tcp/0.0.0.0:7447                for other machines too
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
        return Link(self.robot, connect, listen, router=True, multicast=self.multicast)


def main(argv: list[str] | None = None) -> None:
    """Route until SIGTERM or Ctrl-C; status 0 then, 2 and one line where the endpoints cannot be used."""
    # Blocked from the first line on, so that a signal is kept until sigwait takes it, however early it comes.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    begin_logging(RouterSettings.service, argv)
    try:
        settings = load_settings(RouterSettings, argv)
        set_up_logging(settings.log_level, as_json=settings.log_json, service=RouterSettings.service)
        log = logger(RouterSettings.service)
        with open_bus(settings.link()) as bus, ExitStack() as stack:
            if settings.metrics:
                from common.metrics_endpoint import serve  # noqa: PLC0415
                from common.metrics_router import RouterMetrics  # noqa: PLC0415

                log.info("metrics", address=stack.enter_context(serve(RouterMetrics(bus).registry, settings.metrics)))
            log.info("router listens", endpoints=settings.listen)
            signal.sigwait(ENDING)
        log.info("ended")
    except UserError as error:
        say_failure(RouterSettings.service, error)
        sys.exit(2)


if __name__ == "__main__":
    main()
