"""`presage demo --unknown`: a robot explores a building that it has never seen, is kidnapped, and returns.

The demo acts as the user: it starts the exploration, kidnaps the robot once, and sends a goal. It measures errors with
the true world and the true pose, which no service but the simulator knows.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape

from common.bus.bus import Bus, open_bus
from common.errors import UserError
from common.geometry import se2
from common.geometry.coverage import MIN_PASSAGE_M, mapped_share, points_in, reachable_area
from common.geometry.se2 import Array
from common.geometry.world import World, load_world
from common.messages.definitions import Belief, Goal, Map, Pose, Stamped, Status, Truth
from common.messages.requests import PoseRequest, Reply
from common.messages.topics import BELIEF, GOAL, MAP, STATUS, TELEPORT, TRUTH
from common.runtime.session_files import session_file
from common.versions import commit
from presage.live.latest_messages import LatestMessages
from presage.recordings.session_figure import draw_session
from presage.session.demo import DemoOptions, check_recorded, is_standing, new_recording
from presage.session.page import show_page_link
from presage.session.running_sessions import credentials_for
from presage.session.session_plan import plan_session
from presage.session.stack import Stack
from presage.terminal.options import arguments
from presage.terminal.output import check_file, make_folder, write_json

DEFAULT_WORLD = "office"  # unless the options, the environment or the settings file name another
# The robot is kidnapped when the map has this number of key scans. It must be clearly more than the key scans that are
# taken until the robot is localised again, about 20.
KIDNAP_AT_KEY_SCANS = 40
MIN_KIDNAPPING_M = 5.0  # distance to the place to which the robot is kidnapped
LOCALISED_ERROR_M = 0.2  # error of a belief below which the robot counts as localised
EXPLORATION_SEQ, GOAL_SEQ = 1, 2  # numbers of the two requests
MAX_KEPT_TRUTHS = 256  # a belief arrives later than the truth of its stamp
# Deadlines of the steps, by the wall clock. They are several times longer than a step takes on an idle machine.
FIRST_MAP_TIMEOUT_S, KIDNAPPING_TIMEOUT_S, STEP_TIMEOUT_S, RETURN_TIMEOUT_S = 60.0, 30.0, 240.0, 600.0


class StepError(Exception):
    """A step of the demo failed."""


@dataclass(frozen=True)
class DemoStep:
    """How a step of the demo ended."""

    what: str
    seconds: float  # since the beginning, by the stamps
    mapped_share: float  # of the area that the robot can reach
    error_m: float  # of the belief, or of the place that was reached


class SessionObserver:
    """What happens in the session, measured with the truth."""

    def __init__(self, bus: Bus, stack: Stack, world: World, console: Console) -> None:
        self.stack, self.world, self.console = stack, world, console
        self.messages = LatestMessages(bus, TRUTH, BELIEF, STATUS, MAP)
        self.steps: list[DemoStep] = []
        self.contacts = 0  # truths in which the robot touches something
        self.mapped_share = 0.0
        self.status = Status(stamp_ns=0, state="idle")
        self.belief: Belief | None = None
        self.key_scans = np.zeros((0, 3))  # base_link in map, where the scans of the map were taken
        self._truths: dict[int, Truth] = {}  # by stamp
        self._start: Truth | None = None
        self._area = np.zeros((0, 2))  # points of it that a robot can reach

    @property
    def start(self) -> Array:
        """True pose (3,) at the beginning, which is the origin of the map."""
        assert self._start is not None  # noqa: S101 - the demo begins with the first map, after the first truth
        return self._start.pose.array()

    @property
    def truth(self) -> Truth:
        """The latest true state."""
        return next(reversed(self._truths.values()))

    @property
    def pose(self) -> Array:
        """True pose (3,) in the frame of the map."""
        return np.asarray(se2.between(self.start, self.truth.pose.array()))

    @property
    def seconds(self) -> float:
        """Since the beginning, by the stamps."""
        return 0.0 if self._start is None else (self.truth.stamp_ns - self._start.stamp_ns) * 1e-9

    @property
    def belief_error_m(self) -> float:
        """Error of the latest belief; infinite unless it tracks."""
        truth = None if self.belief is None else self._truths.get(self.belief.stamp_ns)
        if self.belief is None or truth is None or self.belief.state != "tracking":
            return np.inf
        return distance(se2.between(self.start, truth.pose.array()), self.belief.pose.array())

    @property
    def exploration(self) -> str:
        """Phase of the exploration; empty before it began."""
        return "" if self.status.exploration is None else self.status.exploration.phase

    @property
    def standing(self) -> bool:
        """Whether the robot stands."""
        return is_standing(self.truth)

    def wait(self, doing: str, condition: Callable[[], bool], limit_s: float) -> None:
        """Takes messages until a condition is true.

        Raises StepError if that takes longer than ``limit_s``, or the controller refuses a goal or fails to explore.
        """
        deadline = time.monotonic() + limit_s
        with self.console.status(doing) as line:
            while not condition():
                self.stack.check()
                if self.status.refused or self.exploration == "failed":
                    raise StepError(f"{doing}: {self._state()}")
                if time.monotonic() > deadline:
                    raise StepError(f"{doing} took longer than {limit_s:g} s: {self._state()}")
                if (message := self.messages.next(0.5)) is not None:
                    self._take(message)
                line.update(escape(f"{doing}: {self._state()}"))

    def end_step(self, what: str, error_m: float) -> None:
        """Notes and prints how a step ended."""
        self.steps.append(DemoStep(what, self.seconds, self.mapped_share, error_m))
        minutes, seconds = divmod(round(self.seconds), 60)
        self.console.print(
            f"{minutes}:{seconds:02}  {what}; {100 * self.mapped_share:.0f} % mapped", soft_wrap=True, highlight=False
        )

    def _state(self) -> str:
        belief = "no belief" if self.belief is None else f"the belief is {self.belief.state}"
        if np.isfinite(self.belief_error_m):
            belief += f", {1000 * self.belief_error_m:.0f} mm from the truth"
        return f"{100 * self.mapped_share:.0f} % mapped; {belief}; {self.status.state}: {self.status.reason}"

    def _take(self, message: Stamped) -> None:
        if isinstance(message, Truth):
            if self._start is None:
                self._start = message
                self._area = points_in(reachable_area(self.world, MIN_PASSAGE_M / 2, message.pose.array()))
            self._truths[message.stamp_ns] = message
            if len(self._truths) > MAX_KEPT_TRUTHS:
                del self._truths[next(iter(self._truths))]
            self.contacts += message.contact
        elif isinstance(message, Belief):
            self.belief = message
        elif isinstance(message, Status):
            self.status = message
        elif isinstance(message, Map) and self._start is not None:
            self.key_scans, self.mapped_share = message.poses, mapped_share(message.grid, self._area, self.start)


def run_steps(bus: Bus, observer: SessionObserver) -> None:
    """Runs the steps of the demo; raises StepError if one fails."""
    observer.wait("making the first map", lambda: len(observer.key_scans) > 0, FIRST_MAP_TIMEOUT_S)
    bus.put(GOAL, Goal(stamp_ns=0, seq=EXPLORATION_SEQ, pose=Pose(x=0.0, y=0.0), explore=True).encode())
    explore(observer)
    kidnap(bus, observer)
    drive_to_goal(bus, observer)
    return_to_start(observer)


def explore(observer: SessionObserver) -> None:
    """Waits until enough is mapped to kidnap the robot to a mapped place."""

    def enough() -> bool:
        if observer.exploration == "finished":
            raise StepError("exploring: all was mapped before the robot could be kidnapped; choose a larger --world")
        mapped = len(observer.key_scans) >= KIDNAP_AT_KEY_SCANS and np.isfinite(observer.belief_error_m)
        return bool(mapped and distance(farthest_key_scan(observer), observer.pose) >= MIN_KIDNAPPING_M)

    observer.wait("exploring", enough, STEP_TIMEOUT_S)
    error_m = observer.belief_error_m
    observer.end_step(f"explored a building that it has never seen, its belief {mm(error_m)} from the truth", error_m)


def kidnap(bus: Bus, observer: SessionObserver) -> None:
    """Carries the robot to a mapped place, and waits until it is localised there."""
    before, place = observer.pose, farthest_key_scan(observer)
    place = se2.compose(place, [0.0, 0.0, np.pi])  # with a view that is not the one in the map
    reply = bus.query(TELEPORT, PoseRequest(pose=Pose.of(se2.compose(observer.start, place))), Reply)
    if not reply.ok:
        raise StepError(f"the simulator refuses to kidnap the robot: {reply.reason}")
    distance_m = distance(place, before)
    observer.wait(
        "kidnapping the robot", lambda: distance(observer.pose, before) > distance_m / 2, KIDNAPPING_TIMEOUT_S
    )
    kidnapped_ns, kidnapped_s = observer.truth.stamp_ns, observer.seconds

    def found() -> bool:
        return (
            observer.belief is not None
            and observer.belief.stamp_ns > kidnapped_ns
            and observer.belief_error_m < LOCALISED_ERROR_M
        )

    observer.wait("finding itself", found, STEP_TIMEOUT_S)
    error_m, took_s = observer.belief_error_m, observer.seconds - kidnapped_s
    observer.end_step(
        f"was kidnapped, {distance_m:.1f} m away, and found itself in its map after {took_s:.0f} s, "
        f"{mm(error_m)} from the truth",
        error_m,
    )


def drive_to_goal(bus: Bus, observer: SessionObserver) -> None:
    """Sends a goal, which takes precedence over the exploration, and waits until the robot stands there."""
    before, place = observer.pose, farthest_key_scan(observer)
    goal = Goal(stamp_ns=observer.truth.stamp_ns, seq=GOAL_SEQ, pose=Pose(x=place[0], y=place[1]))
    bus.put(GOAL, goal.encode())

    def reached() -> bool:
        return observer.status.goal_seq == GOAL_SEQ and observer.status.state == "reached" and observer.standing

    observer.wait("driving to a goal", reached, STEP_TIMEOUT_S)
    error_m = distance(observer.pose, place)
    observer.end_step(
        f"drove to a goal given meanwhile, {distance(place, before):.1f} m away, and stood {mm(error_m)} from it",
        error_m,
    )


def return_to_start(observer: SessionObserver) -> None:
    """Waits until the rest is explored and the robot is back."""
    observer.wait(
        "exploring the rest", lambda: observer.exploration == "finished" and observer.standing, RETURN_TIMEOUT_S
    )
    error_m = distance(observer.pose, np.zeros(3))
    observer.end_step(f"explored the rest and returned, {mm(error_m)} from where it began", error_m)


def farthest_key_scan(observer: SessionObserver) -> Array:
    """The pose (3,) in map of the key scan that is farthest from the robot."""
    return np.asarray(observer.key_scans[np.argmax(np.hypot(*(observer.key_scans - observer.pose)[:, :2].T))])


def distance(first: Array, second: Array) -> float:
    """Distance in m between the positions of two poses (3,)."""
    return float(np.hypot(*(first - second)[:2]))


def mm(metres: float) -> str:
    """A length as text."""
    return f"{1000 * metres:.0f} mm"


def run_unknown_demo(demo: DemoOptions, stack: Stack, console: Console) -> tuple[Path, SessionObserver, str]:
    """Runs the demo with the services of ``stack``.

    Returns the recording, what was measured, and why a step failed, or an empty text. Raises UserError if an option is
    wrong or a service fails.
    """
    plan = plan_session(demo.config, demo.world, "", arguments(seed=demo.seed), mapping=True)
    if "world" not in plan.simulator_settings.model_fields_set:
        plan = plan_session(demo.config, DEFAULT_WORLD, "", arguments(seed=demo.seed), mapping=True)
    make_folder(demo.out)
    recording, failure = new_recording(demo.out, stack.robot), ""
    stack.start_router()
    with open_bus(stack.link()) as bus:
        observer = SessionObserver(bus, stack, load_world(plan.simulator_settings.world), console)
        if not demo.quiet:
            stack.start("viewer", *plan.config, *arguments(recordings=demo.out))
        stack.start("recorder", *plan.config, *arguments(directory=demo.out, file=recording.name))
        stack.start("mapper", *plan.config)
        stack.start("controller", *plan.controller)
        # The robot must not stand long before it begins, and the recording is to be complete.
        stack.start("simulator", *plan.simulator, *arguments(wait_for="mapper,controller,recorder"))
        with console.status("starting simulator, mapper, controller, recorder"):
            stack.wait_alive(bus)
        if not demo.quiet:
            show_page_link(stack, console, open_it=demo.open_page)
        with session_file(stack.endpoint, [stack.robot], stack.security, stack.start_commands()):
            try:
                run_steps(bus, observer)
            except StepError as error:
                failure = str(error)
        for name in ("controller", "mapper", "simulator"):
            stack.stop(name)
        check_recorded(recording, stack.stop("recorder"))
    return recording, observer, failure


def unknown_demo_command(demo: DemoOptions, json_file: Path | None) -> int:
    """Runs the demo, draws its figure and prints how it ended; returns status 1 if a step failed."""
    if demo.goal is not None or demo.estimator:
        raise UserError("--unknown chooses the goal itself, and runs no estimator: leave out --goal and --estimator")
    check_file(json_file, "--json")
    console = Console(width=None if sys.stdout.isatty() else 150)
    with Stack("robot", quiet=demo.quiet, security=credentials_for("robot")) as stack:
        recording, observer, failure = run_unknown_demo(demo, stack, console)
    figure = recording.with_suffix(".png")
    with console.status("drawing"):
        draw_session(recording, figure)
    files = f"recording: {recording}; figure: {figure}"
    console.print(f"contacts: {observer.contacts}; {files}", soft_wrap=True, highlight=False)
    numbers = {
        "world": observer.world.name,
        "steps": [asdict(step) for step in observer.steps],
        "failure": failure,
        "contacts": observer.contacts,
        "recording": str(recording),
        "seed": demo.seed,
        "commit": commit(),
        "arguments": sys.argv[1:],
    }
    write_json(json_file, numbers)
    ending = f"[bold red]failed[/]: {escape(failure)}" if failure else "[bold green]the robot is back[/]"
    console.print(ending, soft_wrap=True, highlight=False)
    return 1 if failure else 0
