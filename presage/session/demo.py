"""`presage demo`: localise, drive to a goal, record, draw, summarise."""

from __future__ import annotations

import secrets
import sys
import time
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.geometry.world import World, load_world
from common.messages.definitions import Belief, Goal, Health, Pose, Status, Truth
from common.messages.topics import BELIEF, GOAL, HEALTH, STATUS, TRUTH
from common.robot.base import Robot
from common.versions import commit
from presage.live.bus_watch import Watch
from presage.recordings.session_figure import draw_session
from presage.recordings.session_summary import SessionSummary, summarise
from presage.session.page import say_page, start_page
from presage.session.preflight import check_services
from presage.session.stack import Stack, controller_arguments
from presage.terminal.options import credentials_for
from presage.terminal.output import check_file, make_folder, write_json

# By the messages' stamps, whatever the pace:
LOCALISE_WITHIN = 30.0  # s from the first belief; the paper's descent takes 3.3 s
ARRIVE_WITHIN = 90.0  # s from the goal; 12.5 m take about 15
# By the wall's clock:
FIRST_WITHIN = 30.0  # s until there is a belief at all
GIVE_UP = 120.0  # s for localising, and again for the way


@dataclass(frozen=True)
class DemoOptions:
    """What the demo is asked for."""

    world: str = "corridor"
    goal: tuple[float, float] | None = None
    out: Path = Path("recordings")
    beams: int = 622
    seed: int = 0
    pace: str = "realtime"
    port: int | None = None  # None: any free one
    estimator: tuple[str, ...] = ()  # arguments
    viewer: bool = True
    open_page: bool = False  # where there is a display
    people: int = 0  # who walk about


def run_demo(demo: DemoOptions, stack: Stack, console: Console) -> tuple[Path, bool]:
    """The recording, and whether the goal was reached; raises UserError where it cannot be or nothing is believed."""
    goal = _goal(demo, load_world(demo.world))
    make_folder(demo.out, "--out")
    # A name of its own: others may record into the same folder in the same second.
    began = datetime.now(timezone.utc).strftime("%Y%m%d-%H%M%S")
    perceiving = ["--world", demo.world, *demo.estimator]
    driving = controller_arguments(demo.world, demo.estimator, lockstep=demo.pace == "lockstep")
    simulator = ["--world", demo.world, "--beams", str(demo.beams), "--seed", str(demo.seed), "--pace", demo.pace]
    simulator += ["--people", str(demo.people)]
    check_services(demo.world, perceiving, driving, simulator)
    recording = demo.out / f"presage-{stack.robot}-{began}-{secrets.token_hex(3)}.mcap"
    stack.start_router()
    with open_bus(stack.link()) as bus:
        watch = Watch(bus, TRUTH, BELIEF, STATUS, HEALTH)
        page = demo.viewer and start_page(stack, demo.out, console)
        stack.start("recorder", "--directory", str(demo.out), "--file", recording.name)
        stack.start("controller", *driving)
        stack.start("estimator", *perceiving)
        if demo.pace != "realtime":  # time must not have run off before the others see it
            simulator += ["--wait-for", "estimator,controller,recorder"]
        stack.start("simulator", *simulator)
        with console.status("starting simulator, estimator, controller, recorder"):
            stack.wait_alive(bus)
        if page:
            say_page(stack, console, open_it=demo.open_page)
        reached = _localise(watch, stack, console) and _navigate(bus, watch, stack, goal, console)
        stack.check()
        for name in ("controller", "estimator", "simulator"):
            stack.stop(name)
        status = stack.stop("recorder")
    if status != 0 or not recording.exists():
        raise UserError(f"the recorder ended with status {status}; what it has written is {recording}.active")
    return recording, reached


def _goal(demo: DemoOptions, world: World) -> tuple[float, float]:
    """The goal asked for, or a free place at the far end of the paper's corridor, at least 12 m away."""
    robot, start = Robot(), world.start_pose(Robot().radius)
    if demo.goal is not None and not np.isfinite(demo.goal).all():
        raise UserError(f"goal {demo.goal}: two finite numbers are needed, in m, as in --goal 12 2")
    if demo.goal is None:
        _, y0, _, y1 = world.bounds
        free = world.sample_free(2000, np.random.default_rng(demo.seed), robot.radius + 0.3)
        straight = free[np.abs(free[:, 1] - start[1]) < 0.1 * (y1 - y0)]  # the preset goes in a straight line
        far = straight[np.argmax(np.abs(straight[:, 0] - start[0]))] if len(straight) else free[0]
        return (15.5, float(start[1])) if world.name == "corridor" else (float(far[0]), float(far[1]))
    if (clearance := float(world.clearance(demo.goal)[0])) < robot.radius:
        raise UserError(
            f"goal {demo.goal}: {clearance:.2f} m from a wall of {world.name!r}, the robot's radius is {robot.radius} m"
        )
    return demo.goal


def _localise(watch: Watch, stack: Stack, console: Console) -> bool:
    """Stand until the belief has settled, one scan after another; raises UserError where there is none at all."""
    began, first, belief, pulse = time.monotonic(), None, None, None
    with console.status("localising, by the laser alone") as status:
        while (waited := time.monotonic() - began) < GIVE_UP:
            stack.check()
            message = watch.next(0.5)
            if isinstance(message, Health) and message.service == "estimator":
                pulse = message
            if first is None:
                _check_estimator(pulse, waited)
            if isinstance(message, Belief):
                belief, first = message, message.stamp_ns if first is None else first
                truth = watch.latest.get("truth")
                off = f"{_apart(belief, truth):.3f} m from the truth" if isinstance(truth, Truth) else "truth unknown"
                status.update(f"localising: scan {belief.seq}, F = {belief.free_energy:.0f} nats, {off}")
                if belief.state == "tracking":
                    console.print(f"localised after {belief.seq + 1} scans, {off}")
                    return True
                if belief.stamp_ns - first > LOCALISE_WITHIN * 1e9:
                    break
    console.print(
        f"[bold]not localised within {LOCALISE_WITHIN:g} s[/]: the belief is {belief.state if belief else 'unknown'}. "
        "How often that happens: presage bench localisation"
    )
    return False


def _apart(belief: Belief, truth: Truth) -> float:
    return float(np.hypot(*(belief.pose.array() - truth.pose.array())[:2]))


def _check_estimator(pulse: Health | None, waited: float) -> None:
    """Raises UserError with the estimator's own reason where it can use no scan, or says nothing for long."""
    note = (pulse.note if pulse is not None else "") or "nothing"
    if pulse is not None and pulse.counters.get("unfit_scans"):
        raise UserError(f"no belief comes: the estimator says: {note}")
    if waited > FIRST_WITHIN:
        raise UserError(f"no belief came within {FIRST_WITHIN:g} s; the estimator says: {note}. See its lines above")


def _navigate(bus: Bus, watch: Watch, stack: Stack, place: tuple[float, float], console: Console) -> bool:
    """Give the goal and watch until it is reached."""
    if not bus.wait_matching(GOAL, 5.0):
        raise UserError("nobody listens for goals: is the controller running?")
    stamp, began = watch.latest["belief"].stamp_ns, time.monotonic()
    goal = Goal(stamp_ns=stamp, seq=1, pose=Pose(x=place[0], y=place[1]))  # the first: a status without one says 0
    bus.put(GOAL, goal.encode())
    with console.status("navigating") as status:
        while True:
            stack.check()
            said = watch.until(Status, lambda s: s.goal_seq == goal.seq, 5.0)
            if said is None:
                console.print("[bold]the controller has said nothing about the goal for 5 s[/]")
                return False
            if said.distance is not None:
                where = f"({place[0]:g}, {place[1]:g})"
                status.update(f"navigating to {where}: {said.distance:.2f} m to go {said.reason}")
            if said.state == "reached":
                break
            passed = (said.stamp_ns - stamp) * 1e-9
            if said.refused or (said.state == "lost" and passed > 5 and "standing" not in said.reason):
                console.print(f"[bold]{said.state}: {said.reason}[/]")
                return False
            if passed > ARRIVE_WITHIN or time.monotonic() - began > GIVE_UP:
                console.print(f"[bold]not there after {passed:.0f} s[/]: {said.state} {said.reason}")
                return False
    # The last scans of the standing robot belong to the picture.
    return watch.until(Truth, lambda truth: bool(np.hypot(truth.twist.vx, truth.twist.vy) < 0.01), 5.0) is not None


def show(summary: SessionSummary, recording: Path, figure: Path, console: Console) -> None:
    """The numbers, one a line."""
    table = Table(show_header=False, box=None, padding=(0, 2))
    for name, value in summary.lines():
        table.add_row(name, value)
    table.add_row("recording", str(recording))
    table.add_row("figure", str(figure))
    console.print(table)


def demo_command(demo: DemoOptions, json_file: Path | None, *, quiet: bool) -> int:
    """Everything; the exit status."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    check_file(json_file, "--json")
    if quiet:  # nobody looks
        demo = replace(demo, viewer=False)
    with Stack("robot", demo.port, quiet=quiet, security=credentials_for("robot")) as stack:
        recording, reached = run_demo(demo, stack, console)
    figure = recording.with_suffix(".png")
    with console.status("drawing"):
        summary = summarise(recording)
        draw_session(recording, figure)
    show(summary, recording, figure, console)
    write_json(json_file, {**summary.as_dict(), "seed": demo.seed, "commit": commit(), "arguments": sys.argv[1:]})
    console.print("[bold green]goal reached[/]" if reached else "[bold red]goal not reached[/]")
    return 0 if reached else 1


def plot_command(recording: Path, figure: Path, json_file: Path | None, console: Console) -> None:
    """Summary and figure of any recording."""
    check_file(figure, "--out")
    check_file(json_file, "--json")
    summary = summarise(recording)
    draw_session(recording, figure)
    show(summary, recording, figure, console)
    write_json(json_file, {**summary.as_dict(), "commit": commit(), "arguments": sys.argv[1:]})
