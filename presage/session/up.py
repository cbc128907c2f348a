"""`presage up`: all services until Ctrl-C."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console

from common.bus.bus import open_bus
from common.errors import UserError
from presage.session.page import say_page, start_page
from presage.session.preflight import check_services
from presage.session.stack import Stack, controller_arguments
from presage.terminal.options import credentials_for

RECORDINGS = Path("recordings")  # where the page finds them, and puts those it makes


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
    """Start, wait until all are alive, say what can be done, and watch; a service that ends is named, not restarted."""
    names = [robot] if robots == 1 else [f"{robot}-{k}" for k in range(1, robots + 1)]
    if robots > 1 and record is not None:
        raise UserError(f"--record records one robot: leave it out, and `presage record --robot {names[0]}` beside it")
    if not simulated and (robots > 1 or pace != "realtime"):
        raise UserError("--no-simulator goes with one robot, and with time as it passes: leave out --robots and --pace")
    lockstep = pace == "lockstep"
    together = ["--robots", ",".join(names)] if robots > 1 else []
    perceiving = ["--world", world, *estimator, *together]
    driving = controller_arguments(world, estimator, limits, lockstep=lockstep)
    simulator = ["--world", world, *scanner, *limits, "--pace", pace, *people, "--start", start]
    # One clear line now rather than three from the children.
    check_services(world, perceiving, driving, [*simulator, "--seed", str(seed)] if simulated else None)
    with Stack(names[0], port or None, security=credentials_for(names[0])) as stack:
        stack.start_router()
        page = viewer and start_page(stack, record or RECORDINGS, console)
        if (page or record is not None) and robots == 1:  # idle, it waits for the page's button
            stack.start("recorder", "--directory", str(record or RECORDINGS), *(["--idle"] if record is None else []))
        stack.start("estimator", *perceiving)
        stack.start("controller", *driving)
        waits = ",".join(sorted(set(stack.processes) - {"router", "viewer"}))
        simulator += ["--wait-for", waits] if pace != "realtime" else []
        if simulated:
            stack.start("simulator", *simulator, "--seed", str(seed))
        for k, name in enumerate(names[1:], 1):  # each in a simulation of its own
            stack.start_as(f"controller-{k + 1}", "controller", name, *driving)
            stack.start_as(f"simulator-{k + 1}", "simulator", name, *simulator, "--seed", str(seed + k))
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
        if page:
            say_page(stack, console, open_it=open_page)
        where = "" if port == 7447 else f" --connect {stack.endpoint}"
        where += f" --security {stack.security.folder.parent}" if stack.security is not None else ""
        where += "" if names == ["robot"] else f" --robot {names[0]}"
        if robots > 1:
            console.print(f"robots: {', '.join(names)}, one estimator for all", soft_wrap=True)
        goal = "15 1.5" if world == "corridor" else "X Y"
        console.print(
            f"[bold green]all alive[/] at {stack.endpoint}. In another terminal: "
            f"presage goal {goal} --wait{where} | presage echo belief{where} | presage hz{where}. Ctrl-C ends all.",
            soft_wrap=True,
        )
        _watch(stack, console)


def _watch(stack: Stack, console: Console) -> None:
    """Until interrupted, or until nobody is left."""
    said: set[str] = set()
    while True:
        for name in stack.ended():
            if name not in said:
                said.add(name)
                process = stack.processes[name]
                console.print(
                    f"[bold red]{name} ended with status {process.child.returncode}[/]; it is not restarted. "
                    f"Start it again with: {process.again(stack)}",
                    soft_wrap=True,
                )
        if len(said) == len(stack.processes):
            stack.check()
        time.sleep(0.2)
