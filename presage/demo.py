"""`presage demo`: localise from the map's centre, drive to a goal, record, draw, and say how it went."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from common.bus import Bus, open_bus
from common.errors import UserError
from common.messages import Belief, Goal, Pose, Status, Truth
from common.robot import Robot
from common.topics import BELIEF, GOAL, STATUS, TRUTH
from common.versions import commit
from common.world import World, load_world
from presage.figure import draw_session
from presage.session import SessionSummary, summarise
from presage.stack import Stack
from presage.watch import Watch

LOCALISE_WITHIN = 30.0  # s of wall time; 50 iterations take 3.3 s
ARRIVE_WITHIN = 90.0  # s; 12.5 m take about 15


@dataclass(frozen=True)
class Demo:
    """What the demo is asked for."""

    world: str = "corridor"
    goal: tuple[float, float] | None = None
    out: Path = Path("recordings")
    beams: int = 622
    seed: int = 0
    pace: str = "realtime"
    port: int | None = None  # None: any free one


def run_demo(demo: Demo, stack: Stack, console: Console) -> tuple[Path, bool]:
    """The recording, and whether the goal was reached; the figure lies beside it."""
    world = load_world(demo.world)
    goal = _goal(demo, world)
    demo.out.mkdir(parents=True, exist_ok=True)
    before = set(demo.out.glob("*.mcap"))
    stack.start_router()
    with open_bus(stack.link()) as bus:
        watch = Watch(bus, TRUTH, BELIEF, STATUS)
        stack.start("recorder", "--directory", str(demo.out))
        stack.start(
            "controller", "--world", demo.world, *(["--belief-timeout", "20"] if demo.pace == "lockstep" else [])
        )
        stack.start("estimator", "--world", demo.world)
        simulator = ["--world", demo.world, "--beams", str(demo.beams), "--seed", str(demo.seed), "--pace", demo.pace]
        if demo.pace == "lockstep":
            simulator += ["--wait-for", "estimator,controller,recorder"]
        stack.start("simulator", *simulator)
        with console.status("starting simulator, estimator, controller, recorder"):
            stack.wait_alive(bus)
        reached = _localise(watch, stack, console) and _navigate(bus, watch, stack, goal, console)
        stack.check()
        for name in ("controller", "estimator", "simulator"):
            stack.stop(name)
        status = stack.stop("recorder")
    files = set(demo.out.glob("*.mcap")) - before
    if status != 0 or len(files) != 1:
        raise UserError(f"the recorder ended with status {status} and left {len(files)} new files in {demo.out}")
    return files.pop(), reached


def _goal(demo: Demo, world: World) -> tuple[float, float]:
    """The goal asked for, or a free place at the far end of the paper's corridor, at least 12 m away."""
    robot, start = Robot(), world.start_pose(Robot().radius)
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
    """Stand until the belief has settled, from the map's centre and one scan after another."""
    with console.status("localising from the map's centre, by the laser alone") as status:
        for _ in range(int(LOCALISE_WITHIN * 100)):
            message = watch.next(0.5)
            if message is None:
                stack.check()
            belief, truth = watch.latest.get("belief"), watch.latest.get("truth")
            if isinstance(belief, Belief) and isinstance(truth, Truth):
                error = float(np.hypot(*(belief.pose.array() - truth.pose.array())[:2]))
                status.update(f"localising: scan {belief.seq}, F = {belief.free_energy:.0f} nats, error {error:.2f} m")
                if belief.state == "tracking":
                    console.print(f"localised after {belief.seq + 1} scans, {error:.3f} m from the truth")
                    return True
                if belief.stamp_ns > LOCALISE_WITHIN * 1e9:
                    break
    console.print(
        f"[bold]not localised within {LOCALISE_WITHIN:g} s[/]: the paper's descent has stopped in a wrong place. "
        "How often it does: presage bench localisation"
    )
    return False


def _navigate(bus: Bus, watch: Watch, stack: Stack, goal: tuple[float, float], console: Console) -> bool:
    """Give the goal and watch until it is reached."""
    belief = watch.latest["belief"]
    if not bus.wait_matching(GOAL, 5.0):
        raise UserError("nobody listens for goals: is the controller running?")
    bus.put(GOAL, Goal(stamp_ns=belief.stamp_ns, pose=Pose(x=goal[0], y=goal[1])).encode())
    began = belief.stamp_ns
    with console.status("navigating") as status:
        while (message := watch.next(5.0)) is not None:
            stack.check()
            if not isinstance(message, Status) or message.goal is None:
                continue
            if message.distance is not None:
                status.update(
                    f"navigating to ({goal[0]:g}, {goal[1]:g}): {message.distance:.2f} m to go {message.reason}"
                )
            if message.state == "reached":
                break
            if (
                message.state in {"blocked", "lost"}
                and message.stamp_ns - began > 5e9
                and "standing" not in message.reason
            ):
                console.print(f"[bold]{message.state}: {message.reason}[/]")
                return False
            if message.stamp_ns - began > ARRIVE_WITHIN * 1e9:
                console.print(f"[bold]not there after {ARRIVE_WITHIN:g} s[/]")
                return False
    stack.check()
    # The last scans of the standing robot belong to the picture.
    arrived = watch.until(Truth, lambda truth: bool(np.hypot(truth.twist.vx, truth.twist.vy) < 0.01), 5.0)
    return message is not None and arrived is not None


def show(summary: SessionSummary, recording: Path, figure: Path, console: Console) -> None:
    """The numbers, one a line."""
    table = Table(show_header=False, box=None, padding=(0, 2))
    for name, value in summary.lines():
        table.add_row(name, value)
    table.add_row("recording", str(recording))
    table.add_row("figure", str(figure))
    console.print(table)


def demo_command(demo: Demo, json_file: Path | None, *, quiet: bool) -> int:
    """Everything; the exit status."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    with Stack("robot", demo.port, quiet=quiet) as stack:
        recording, reached = run_demo(demo, stack, console)
    figure = recording.with_suffix(".png")
    with console.status("drawing"):
        summary = summarise(recording)
        draw_session(recording, figure)
    show(summary, recording, figure, console)
    if json_file is not None:
        data = {**summary.as_dict(), "seed": demo.seed, "commit": commit(), "arguments": sys.argv[1:]}
        json_file.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    console.print("[bold green]goal reached[/]" if reached else "[bold red]goal not reached[/]")
    return 0 if reached else 1


def plot_command(recording: Path, figure: Path, json_file: Path | None, console: Console) -> None:
    """Summary and figure of any recording."""
    summary = summarise(recording)
    draw_session(recording, figure)
    show(summary, recording, figure, console)
    if json_file is not None:
        data = {**summary.as_dict(), "commit": commit(), "arguments": sys.argv[1:]}
        json_file.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
