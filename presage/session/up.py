"""`presage up`: all services until Ctrl-C."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from common.bus.bus import open_bus
from common.errors import UserError
from presage.session.page import show_page_link, start_page
from presage.session.preflight import check_services
from presage.session.stack import Stack, controller_arguments
from presage.terminal.options import credentials_for

RECORDINGS = Path("recordings")  # folder whose recordings the live page shows, and into which it records


def run_up(
    *,
    world: str,
    scanner: tuple[str, ...],
    limits: tuple[str, ...],
    pace: str,
    seed: int,
    record: Path | None,
    robot: str,
    simulated: bool = True,
    port: int,
    console: Console,
    estimator: tuple[str, ...] = (),
    viewer: bool = True,
    open_page: bool = False,
    people: tuple[str, ...] = (),
    start: str = "",
    robots: int = 1,
) -> None:
    """Starts all services, waits until they are alive, prints hints, and runs until Ctrl-C.

    A service that ends is reported and not restarted. Raises UserError when all have ended.
    """
    names = [robot] if robots == 1 else [f"{robot}-{k}" for k in range(1, robots + 1)]
    if robots > 1 and record is not None:
        raise UserError(
            f"--record records one robot only: leave it out, and run `presage record --robot {names[0]}` beside it"
        )
    if not simulated and (robots > 1 or pace != "realtime"):
        raise UserError("--no-simulator allows one robot in real time only: leave out --robots and --pace")
    lockstep = pace == "lockstep"
    estimator_args = ["--world", world, *estimator]
    if robots > 1:
        estimator_args += ["--robots", ",".join(names)]
    controller_args = controller_arguments(world, estimator, limits, lockstep=lockstep)
    simulator_args = ["--world", world, *scanner, *limits, "--pace", pace, *people, "--start", start]
    # Without this check, each child would report the same mistake in its own log.
    check_services(
        world, estimator_args, controller_args, [*simulator_args, "--seed", str(seed)] if simulated else None
    )
    with Stack(names[0], port or None, security=credentials_for(names[0])) as stack:
        stack.start_router()
        page = viewer and start_page(stack, record or RECORDINGS, console)
        if (page or record is not None) and robots == 1:  # an idle recorder starts from a button on the page
            stack.start("recorder", "--directory", str(record or RECORDINGS), *(["--idle"] if record is None else []))
        stack.start("estimator", *estimator_args)
        stack.start("controller", *controller_args)
        awaited = ",".join(sorted(set(stack.processes) - {"router", "viewer"}))
        simulator_args += ["--wait-for", awaited] if pace != "realtime" else []
        if simulated:
            stack.start("simulator", *simulator_args, "--seed", str(seed))
        for k, name in enumerate(names[1:], 1):  # each further robot has its own simulation
            stack.start_instance(f"controller-{k + 1}", "controller", name, *controller_args)
            stack.start_instance(f"simulator-{k + 1}", "simulator", name, *simulator_args, "--seed", str(seed + k))
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
        if page:
            show_page_link(stack, console, open_it=open_page)
        options = "" if port == 7447 else f" --connect {stack.endpoint}"
        options += f" --security {stack.security.folder.parent}" if stack.security is not None else ""
        options += "" if names == ["robot"] else f" --robot {names[0]}"
        if robots > 1:
            console.print(f"robots: {', '.join(names)}, with one estimator for all", soft_wrap=True)
        goal = "15 1.5" if world == "corridor" else "X Y"
        console.print(
            f"[bold green]all alive[/] at {stack.endpoint}. In another terminal: presage goal {goal} --wait{options} | "
            f"presage echo belief{options} | presage hz{options}. Ctrl-C ends all services.",
            soft_wrap=True,
        )
        _watch(stack, console)


def _watch(stack: Stack, console: Console) -> None:
    """Reports services that end; returns never, and raises UserError when all have ended."""
    reported: set[str] = set()
    while True:
        for name in stack.ended():
            if name not in reported:
                reported.add(name)
                process = stack.processes[name]
                console.print(
                    f"[bold red]{name} ended with status {process.child.returncode}[/]; it is not restarted. "
                    f"Start it again with: {process.restart_command(stack)}",
                    soft_wrap=True,
                )
        if len(reported) == len(stack.processes):
            stack.check()
        time.sleep(0.2)
