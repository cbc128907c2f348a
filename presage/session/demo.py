"""`presage demo`: localise, drive to a goal, record, draw, summarise."""

from __future__ import annotations

import secrets
import sys
import time
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
from rich.console import Console

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.geometry.world import World, load_world
from common.messages.definitions import Belief, Goal, Health, Pose, Status, Truth
from common.messages.topics import BELIEF, GOAL, HEALTH, STATUS, TRUTH
from common.robot.robot import Robot
from common.runtime.session_files import session_file
from common.versions import commit
from presage.live.latest_messages import LatestMessages
from presage.recordings.session_figure import draw_session
from presage.recordings.session_summary import print_summary, summarise
from presage.session.page import show_page_link
from presage.session.running_sessions import credentials_for
from presage.session.session_plan import plan_session
from presage.session.stack import Stack
from presage.terminal.options import arguments
from presage.terminal.output import check_file, make_folder, write_json

# Measured with the stamps of the messages, so that they do not depend on the pace of the simulation:
LOCALISATION_TIMEOUT_S = 30.0  # from the first belief; preset paper takes 3.3 s
ARRIVAL_TIMEOUT_S = 90.0  # from the goal; 12.5 m take about 15 s
# Measured with the wall clock:
FIRST_BELIEF_TIMEOUT_S = 30.0
WALL_TIMEOUT_S = 120.0  # for localising, and again for the drive
MAX_STANDING_SPEED_M_S = 0.01
DEMO_BEAMS = 622  # as in the paper, unless the settings give another number


@dataclass(frozen=True)
class DemoOptions:
    """Options of `presage demo`; what is None or empty is left to the environment, the settings file and defaults."""

    config: Path | None = None
    world: str = ""
    goal: tuple[float, float] | None = None
    out: Path = Path("recordings")
    seed: int = 0
    estimator: str = ""
    quiet: bool = False  # no log lines of the services, no live page
    open_page: bool = False


def run_demo(demo: DemoOptions, stack: Stack, console: Console) -> tuple[Path, bool]:
    """Runs the demo with the services of ``stack``; returns the recording, and whether the goal was reached.

    Raises UserError if an option is wrong, a service fails, or no belief comes.
    """
    plan = plan_session(demo.config, demo.world, "", arguments(seed=demo.seed), arguments(estimator=demo.estimator))
    goal = _choose_goal(demo, load_world(plan.estimator_settings.world))
    make_folder(demo.out)
    recording = new_recording(demo.out, stack.robot)
    simulator = list(plan.simulator)
    if plan.simulator_settings.beams is None:
        simulator += arguments(beams=DEMO_BEAMS)
    stack.start_router()
    with open_bus(stack.link()) as bus:
        messages = LatestMessages(bus, TRUTH, BELIEF, STATUS, HEALTH)
        if not demo.quiet:
            stack.start("viewer", *plan.config, *arguments(recordings=demo.out))
        stack.start("recorder", *plan.config, *arguments(directory=demo.out, file=recording.name))
        stack.start("controller", *plan.controller)
        stack.start("estimator", *plan.estimator)
        if plan.simulator_settings.pace != "realtime":  # simulated time must not pass before the other services run
            simulator += arguments(wait_for="estimator,controller,recorder")
        stack.start("simulator", *simulator)
        with console.status("starting simulator, estimator, controller, recorder"):
            stack.wait_alive(bus)
        if not demo.quiet:
            show_page_link(stack, console, open_it=demo.open_page)
        with session_file(stack.endpoint, [stack.robot], stack.security, stack.start_commands()):
            reached = _localise(messages, stack, console) and _navigate(bus, messages, stack, goal, console)
        stack.check()
        for name in ("controller", "estimator", "simulator"):
            stack.stop(name)
        check_recorded(recording, stack.stop("recorder"))
    return recording, reached


def new_recording(folder: Path, robot: str) -> Path:
    """Path of a new recording, unique also among demos that begin in the same second."""
    start_time = datetime.now(timezone.utc).strftime("%Y%m%d-%H%M%S")
    return folder / f"presage-{robot}-{start_time}-{secrets.token_hex(3)}.mcap"


def check_recorded(recording: Path, status: int) -> None:
    """Raises UserError if the recorder, which ended with ``status``, left no complete recording."""
    if status != 0 or not recording.exists():
        raise UserError(
            f"the recorder ended with status {status}; the unfinished recording is {recording}.active "
            "(`presage recover` completes it)"
        )


def _choose_goal(demo: DemoOptions, world: World) -> tuple[float, float]:
    """The goal of the options; defaults to the far end of the corridor, or a free place far from the start."""
    robot, start = Robot(), world.start_pose(Robot().radius)
    if demo.goal is not None and not np.isfinite(demo.goal).all():
        raise UserError(f"goal {demo.goal}: two finite numbers are needed, in m, as in --goal 12 2")
    if demo.goal is None:
        _, y0, _, y1 = world.bounds
        free = world.sample_free(2000, np.random.default_rng(demo.seed), robot.radius + 0.3)
        if (floor := world.floor_at(start)) is not None:
            free = free[[floor.contains(place) for place in free]]
        aligned = free[np.abs(free[:, 1] - start[1]) < 0.1 * (y1 - y0)]  # preset paper drives in a straight line
        farthest = aligned[np.argmax(np.abs(aligned[:, 0] - start[0]))] if len(aligned) else free[0]
        return (15.5, float(start[1])) if world.name == "corridor" else (float(farthest[0]), float(farthest[1]))
    if not world.has_room(np.array(demo.goal), robot.radius):
        # Imported here because it is slow to import.
        from services.controller.policies.planner import GeodesicPolicy

        raise UserError(f"goal {GeodesicPolicy(robot, world).refusal(np.array(demo.goal))} (--goal)")
    return demo.goal


def _localise(messages: LatestMessages, stack: Stack, console: Console) -> bool:
    """Waits until the belief is in state tracking; returns False on timeout, raises UserError if no belief comes."""
    start_s = time.monotonic()
    first_stamp: int | None = None
    belief: Belief | None = None
    health: Health | None = None
    with console.status("localising with the laser only") as line:
        while (waited := time.monotonic() - start_s) < WALL_TIMEOUT_S:
            stack.check()
            message = messages.next(0.5)
            if isinstance(message, Health) and message.service == "estimator":
                health = message
            if first_stamp is None:
                _check_estimator(health, waited)
            if isinstance(message, Belief):
                belief, first_stamp = message, message.stamp_ns if first_stamp is None else first_stamp
                truth = messages.latest.get("truth")
                error = (
                    f"{_position_error(belief, truth):.3f} m from the truth"
                    if isinstance(truth, Truth)
                    else "truth unknown"
                )
                energy = "" if belief.free_energy is None else f"F = {belief.free_energy:.0f} nats, "
                line.update(f"localising: scan {belief.seq}, {energy}{error}")
                if belief.state == "tracking":
                    console.print(f"localised at scan {belief.seq + 1}, {error}")
                    return True
                if belief.stamp_ns - first_stamp > LOCALISATION_TIMEOUT_S * 1e9:
                    break
    console.print(
        f"[bold]not localised within {LOCALISATION_TIMEOUT_S:g} s[/]: the belief is "
        f"{belief.state if belief else 'unknown'}. `presage bench localisation` measures how often this happens"
    )
    return False


def _position_error(belief: Belief, truth: Truth) -> float:
    return float(np.hypot(*(belief.pose.array() - truth.pose.array())[:2]))


def _check_estimator(health: Health | None, waited: float) -> None:
    """Raises UserError with the note of the estimator's health if it cannot use the scans, or after a timeout."""
    note = (health.note if health is not None else "") or "nothing"
    if health is not None and health.counters.get("unfit_scans"):
        raise UserError(f"the estimator publishes no belief; its health reports: {note}")
    if waited > FIRST_BELIEF_TIMEOUT_S:
        raise UserError(
            f"no belief came within {FIRST_BELIEF_TIMEOUT_S:g} s; the estimator's health reports: {note}. See its log "
            "lines above"
        )


def _navigate(bus: Bus, messages: LatestMessages, stack: Stack, place: tuple[float, float], console: Console) -> bool:
    """Sends the goal and waits for the outcome; returns whether the goal was reached."""
    if not bus.wait_matching(GOAL, 5.0):
        raise UserError("no controller receives goals: is it running?")
    stamp, start_s = messages.latest["belief"].stamp_ns, time.monotonic()
    goal = Goal(stamp_ns=stamp, seq=1, pose=Pose(x=place[0], y=place[1]))  # seq 0 in a status means no goal
    bus.put(GOAL, goal.encode())
    with console.status("navigating") as line:
        while True:
            stack.check()
            status = messages.wait_for(Status, lambda s: s.goal_seq == goal.seq, 5.0)
            if status is None:
                console.print("[bold]the controller has published no status of the goal for 5 s[/]")
                return False
            if status.distance is not None:
                target = f"({place[0]:g}, {place[1]:g})"
                line.update(f"navigating to {target}: {status.distance:.2f} m to go {status.reason}")
            if status.state == "reached":
                console.print(f"reached: {status.reason}")
                break
            passed = (status.stamp_ns - stamp) * 1e-9
            no_belief = status.state == "lost" and status.distance is None
            if status.refused or (no_belief and passed > 5):
                console.print(f"[bold]{status.state}: {status.reason}[/]")
                return False
            if passed > ARRIVAL_TIMEOUT_S or time.monotonic() - start_s > WALL_TIMEOUT_S:
                console.print(f"[bold]not at the goal after {passed:.0f} s[/]: {status.state} {status.reason}")
                return False
    # Wait until the robot stands, so that the recording and the figure contain the end of the drive.
    return messages.wait_for(Truth, is_standing, 5.0) is not None


def is_standing(truth: Truth) -> bool:
    """Whether the robot stands."""
    return bool(np.hypot(truth.twist.vx, truth.twist.vy) < MAX_STANDING_SPEED_M_S)


def demo_command(demo: DemoOptions, json_file: Path | None) -> int:
    """Runs the demo, prints its summary and draws its figure; returns status 1 if the goal was not reached."""
    console = Console(width=None if sys.stdout.isatty() else 150)
    check_file(json_file, "--json")
    with Stack("robot", quiet=demo.quiet, security=credentials_for("robot")) as stack:
        recording, reached = run_demo(demo, stack, console)
    figure = recording.with_suffix(".png")
    with console.status("drawing"):
        summary = summarise(recording)
        draw_session(recording, figure)
    print_summary(summary, recording, figure, console)
    write_json(json_file, {**summary.as_dict(), "seed": demo.seed, "commit": commit(), "arguments": sys.argv[1:]})
    console.print(f"[bold green]goal {summary.goal_result()}[/]" if reached else "[bold red]goal not reached[/]")
    return 0 if reached else 1
