"""`presage up`: all services until Ctrl-C."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from common.bus.bus import open_bus
from common.errors import UserError
from common.runtime.config import load_settings
from common.runtime.session_files import session_file
from presage.session.page import show_page_link
from presage.session.running_sessions import check_robot_name, credentials_for
from presage.session.session_plan import SessionPlan, plan_session
from presage.session.stack import Stack
from presage.terminal.options import arguments
from services.estimator.settings import EstimatorSettings


@dataclass(frozen=True)
class UpOptions:
    """Options of `presage up`; an empty config, world or drive is left to environment, settings file and defaults."""

    config: Path | None = None
    world: str = ""
    drive: str = ""
    simulator: list[str] = field(default_factory=list)  # further arguments of the simulator
    estimator: list[str] = field(default_factory=list)  # further arguments of the estimator
    robots: int = 1
    record: Path | None = None  # folder; if None, recording begins with the button on the page
    port: int = 7447  # 0 chooses a free port
    mapping: bool = False  # maps an unknown building instead of localising in a known world
    without: frozenset[str] = frozenset()  # services that are not started
    open_page: bool = False


def run_up(options: UpOptions, console: Console) -> None:
    """Starts all services, waits until they are alive, prints hints, and runs until Ctrl-C.

    A service that ends is reported and not restarted. Raises UserError when all have ended.
    """
    simulated = "simulator" not in options.without
    plan = plan_session(
        options.config,
        options.world,
        options.drive,
        options.simulator,
        options.estimator,
        simulated=simulated,
        mapping=options.mapping,
    )
    robot, pace = plan.estimator_settings.robot, plan.simulator_settings.pace
    robots = [robot] if options.robots == 1 else [f"{robot}-{k}" for k in range(1, options.robots + 1)]
    _check_combination(options, robots[0], simulated=simulated, pace=pace)
    if len(robots) > 1:
        _check_fleet(options, plan, robots)
    with Stack(robots[0], options.port or None, security=credentials_for(robots[0])) as stack:
        stack.start_router()
        page = "viewer" not in options.without
        if page:
            stack.start("viewer", *plan.config, *arguments(recordings=options.record))
        _start_services(stack, options, plan, robots, page=page)
        with open_bus(stack.link()) as bus:
            stack.wait_alive(bus)
        if page:
            show_page_link(stack, console, open_it=options.open_page)
        with session_file(stack.endpoint, robots, stack.security, stack.start_commands()):
            if options.mapping:
                console.print(
                    "[bold green]mapping[/]: click a goal, press Explore or use the arrow keys on the page, or use "
                    "`presage goal X Y` or `presage explore` in another terminal; then save the map on the page or "
                    "with `presage save-map NAME`."
                )
            else:
                _show_hints(stack, plan.estimator_settings.world, robots, console)
            _watch(stack, console)


def _check_combination(options: UpOptions, first_robot: str, *, simulated: bool, pace: str) -> None:
    """Raises UserError for options that exclude one another."""
    if options.robots > 1 and options.record is not None:
        raise UserError(
            "--record records one robot only: leave it out, and record each robot from another terminal, as with "
            f"`presage --robot {first_robot} record`"
        )
    if not simulated and (options.robots > 1 or pace != "realtime"):
        raise UserError(
            "--no-simulator supports one robot in real time only: leave out --robots, and remove pace from the settings"
        )
    if options.mapping and options.estimator:
        raise UserError("--mapping runs no estimator: leave out --estimator, --model and --learn")
    if options.mapping and options.robots > 1:
        raise UserError("--mapping maps with one robot: leave out --robots")


def _check_fleet(options: UpOptions, plan: SessionPlan, robots: list[str]) -> None:
    """Raises UserError if the services of several robots would refuse a name or a setting."""
    for name in robots:
        check_robot_name(name)
    if "estimator" not in options.without:
        load_settings(EstimatorSettings, [*plan.estimator, *arguments(robots=",".join(robots))]).check_several_robots()


def _start_services(stack: Stack, options: UpOptions, plan: SessionPlan, robots: list[str], *, page: bool) -> None:
    record, without = options.record, options.without
    # An idle recorder begins when the button on the page is pressed.
    if (page or record is not None) and len(robots) == 1:
        stack.start("recorder", *plan.config, *arguments(directory=record, idle=record is None))
    if options.mapping:
        stack.start("mapper", *plan.config)
    elif "estimator" not in without:
        stack.start("estimator", *plan.estimator, *arguments(robots=",".join(robots) if len(robots) > 1 else ""))
    if "controller" not in without:
        stack.start("controller", *plan.controller)
    simulator = list(plan.simulator)
    if plan.simulator_settings.pace != "realtime":
        simulator += arguments(wait_for=",".join(sorted(set(stack.processes) - {"router", "viewer"})))
    if "simulator" not in without:
        stack.start("simulator", *simulator)
    for k, name in enumerate(robots[1:], 1):  # each further robot has its own simulation
        if "controller" not in without:
            stack.start_instance(f"controller-{k + 1}", "controller", name, *plan.controller)
        seed = arguments(seed=plan.simulator_settings.seed + k)
        stack.start_instance(f"simulator-{k + 1}", "simulator", name, *simulator, *seed)


def _show_hints(stack: Stack, world: str, robots: list[str], console: Console) -> None:
    if len(robots) > 1:
        console.print(f"robots: {', '.join(robots)}, with one estimator for all", soft_wrap=True)
    goal = "15 1.5" if world == "corridor" else "X Y"
    presage = "presage" if len(robots) == 1 else f"presage --robot {robots[0]}"
    console.print(
        f"[bold green]all alive[/] at {stack.endpoint}. In another terminal: {presage} goal {goal} --wait | "
        f"{presage} echo belief | {presage} hz. Ctrl-C ends all services.",
        soft_wrap=True,
    )


def _watch(stack: Stack, console: Console) -> None:
    """Reports services that end; never returns, and raises UserError when all have ended."""
    reported: set[str] = set()
    while True:
        for name in stack.ended():
            if name not in reported:
                reported.add(name)
                process = stack.processes[name]
                console.print(
                    f"[bold red]{name} ended with status {process.child.returncode}[/]; it is not restarted. "
                    f"Start it again with: {process.restart_command}",
                    soft_wrap=True,
                )
        if len(reported) == len(stack.processes):
            stack.check()
        time.sleep(0.2)
