"""A robot with a scanner in a world: commands in; scans, odometry and truth out."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import shapely

from common.errors import UserError
from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import Obstacle, World
from common.messages.definitions import Odom, Pose, Scan, Truth, Twist
from common.robot.base import Robot
from common.robot.scanner import Scanner
from common.runtime import safety
from services.simulator.odometry import Drift, Odometer
from services.simulator.physics import SUBSTEP, Physics

if TYPE_CHECKING:
    from services.simulator.people import People

BLOCK = 200  # poses of a sample at once


@dataclass(frozen=True)
class Setup:
    """Everything a run depends on."""

    world: World
    scanner: Scanner
    robot: Robot = field(default_factory=Robot)
    start: tuple[float, float, float] | None = None  # x m, y m, yaw rad; None: the world's own
    seed: int = 0
    drift: Drift = field(default_factory=Drift)
    obstacle_stop: bool = True  # off only for fault injection
    people: int = 0
    people_speed: float = 1.0  # m/s


class Simulation:
    """Same setup and commands, same bytes."""

    def __init__(self, setup: Setup) -> None:
        """At time 0; raises UserError where the robot would stand in a wall, or the people have no room."""
        self.setup, self.world = setup, _named(setup.world)
        robot, scanner = setup.robot, setup.scanner
        pose = np.array(setup.start) if setup.start is not None else self.world.start_pose(robot.radius)
        if (why := self.why_not(pose)) is not None:
            raise UserError(f"start {why}")
        # Streams of their own: people change no noise.
        scan_seed, odom_seed, people_seed = np.random.SeedSequence(setup.seed).spawn(3)
        self.people: People | None = None
        if setup.people:
            # scipy takes half a second to import; a world without people does without.
            from services.simulator.people import People  # noqa: PLC0415

            walking = np.random.default_rng(people_seed)
            self.people = People(self.world, setup.people, setup.people_speed, walking, pose[:2], robot.radius)
        self.physics = Physics(self.world, robot, pose)
        for obstacle in self.world.obstacles:
            self.physics.add(obstacle.name, obstacle)
        if self.people is not None:
            self.physics.add_people(self.people.places, self.people.radius)
        self._noise = np.random.default_rng(scan_seed)
        self.odometer = Odometer(setup.drift, np.random.default_rng(odom_seed))
        self.substeps = max(1, round(1 / (scanner.rate * SUBSTEP)))
        self.steps = 0
        self._velocity = np.zeros(3)  # what the wheels are told, after ramp
        self._command: tuple[int, Array] | None = None  # stamp and twist
        self._heard = 0  # steps when the last newer command came
        self.hurry = 1.0  # how much faster than a controller's clock time runs here: it may take that much longer
        self._contact = self._stopped = False
        self._points = np.zeros((0, 2))

    def close(self) -> None:
        """Give the physics back."""
        self.physics.close()

    @property
    def period_ns(self) -> int:
        """Between scans."""
        return round(self.substeps * SUBSTEP * 1e9)

    @property
    def stamp_ns(self) -> int:
        """Simulation time."""
        return self.steps * self.period_ns

    @property
    def answered(self) -> bool:
        """Whether the command that answers the scan of now has come."""
        return self._command is not None and self._command[0] == self.stamp_ns

    def command(self, stamp_ns: int, twist: Twist) -> bool:
        """Take a command; False where it answers a scan too old, one before the last one's, or one that never was."""
        age, before = self.stamp_ns - stamp_ns, -1 if self._command is None else self._command[0]
        if age < 0 or age > self.setup.robot.command_age * 1e9 or stamp_ns < before:
            return False
        if stamp_ns > before:  # one said again keeps nothing going
            self._heard = self.steps
        self._command = (stamp_ns, safety.clip_twist(twist.array(), self.setup.robot))
        return True

    def advance(self) -> None:
        """One scan period."""
        silent = (self.steps - self._heard) * self.period_ns * 1e-9 >= self.setup.robot.command_timeout * self.hurry
        wanted = np.zeros(3) if silent else self._wanted()
        before = self.physics.pose()
        self._walk(before)
        self._contact = False
        for _ in range(self.substeps):
            self._velocity = safety.ramp(self._velocity, wanted, self.setup.robot, SUBSTEP, hard=silent)
            self._contact |= self.physics.drive(self._velocity)
        self.odometer.move(before, self.physics.pose())
        self.steps += 1

    def _walk(self, pose: Array) -> None:
        """The people's step; the robot is at ``pose`` (3,)."""
        if self.people is not None:
            velocity = se2.rotate(float(pose[2]), self.physics.twist()[:2])
            self.people.step(self.period_ns * 1e-9, pose[:2], velocity)
            self.physics.move_people(self.people.places)

    def _wanted(self) -> Array:
        """The velocity to aim at: the command while it is fresh, no faster than what the last scan shows allows."""
        self._stopped = False
        if self._command is None or self.stamp_ns - self._command[0] > self.setup.robot.command_age * 1e9:
            return np.zeros(3)
        if not self.setup.obstacle_stop:
            return self._command[1]
        # Each period ends in a velocity from which braking is clear: that way out is taken where no other is left.
        wanted, self._stopped = safety.limit_velocity(
            self._command[1], self._points, self.setup.robot, self._velocity, self.period_ns * 1e-9
        )
        return wanted

    def observe(self) -> tuple[Odom, Truth, Scan]:
        """What is measured now; draws the scanner's noise."""
        pose, twist, scanner = self.physics.pose(), self.physics.twist(), self.setup.scanner
        exact = self._see(pose[None])[0]
        ranges = scanner.limit(scanner.noisy(exact, self._noise))
        moving = Twist(vx=float(twist[0]), vy=float(twist[1]), wz=float(twist[2]))
        odometer = self.odometer
        odom = Odom(
            stamp_ns=self.stamp_ns, pose=Pose.of(odometer.pose), twist=moving, covariance=odometer.covariance.copy()
        )
        truth = Truth(
            stamp_ns=self.stamp_ns, pose=Pose.of(pose), twist=moving, contact=self._contact, stopped=self._stopped,
            people=np.zeros((0, 2), np.float32) if self.people is None else self.people.places.astype(np.float32),
        )  # fmt: skip
        scan = self._scan(ranges)
        self._points = safety.scan_points(scan)
        return odom, truth, scan

    def _scan(self, ranges: Array) -> Scan:
        scanner = self.setup.scanner
        return Scan(
            stamp_ns=self.stamp_ns,
            angle_min=scanner.angle_min,
            angle_increment=scanner.angle_increment,
            range_min=scanner.range_min,
            range_max=scanner.range_max,
            ranges=ranges.astype(np.float32),
            mount=Pose.of(scanner.mount),
            scan_time=self.period_ns * 1e-9,
            sigma=scanner.sigma,
            sigma_relative=scanner.sigma_relative,
        )

    def _see(self, poses: Array, scanner: Scanner | None = None, *, people: bool = True) -> Array:
        """(N, B) m without noise or limits from base_link poses (N, 3)."""
        scanner = scanner or self.setup.scanner
        lasers = se2.compose(poses, np.array(scanner.mount))
        # A little beyond the limit, so that noise decides about a return at the limit.
        reach = scanner.range_max + 6 * float(scanner.deviation(np.array(scanner.range_max))) + 1e-6
        return self.physics.ranges(lasers, scanner.angles(), reach, people=people)

    def sample(self, poses: Array, beams: int | None, noise_seed: int | None) -> Array:
        """(N, B) m seen from poses (N, 3), with noise of a seed or none; the robot and its noise do not notice.

        The world alone, for what learns it: no people.
        """
        scanner = self.setup.scanner.with_beams(beams)
        lasers = se2.compose(poses, np.array(scanner.mount))
        for what, where in (("", poses), (" with the laser", lasers)):
            inside = self.world.clearance(where[:, :2]) <= 0
            if inside.any():
                x, y, _ = poses[int(np.argmax(inside))]
                raise UserError(
                    f"{inside.sum()} of {len(poses)} poses are{what} inside a wall or outside,"
                    f" such as ({x:.2f}, {y:.2f})"
                )
        rows = [self._see(poses[i : i + BLOCK], scanner, people=False) for i in range(0, len(poses), BLOCK)]
        ranges = np.concatenate(rows) if rows else np.zeros((0, scanner.beams))
        if noise_seed is not None:
            ranges = scanner.noisy(ranges, np.random.default_rng(noise_seed))
        return scanner.limit(ranges)

    def why_not(self, pose: Array) -> str | None:
        """Why the robot cannot stand at a pose (3,), or None."""
        return self.world.why_no_room(pose, self.setup.robot.radius)

    def teleport(self, pose: Array) -> None:
        """Carry the robot off, standing; odometry does not notice, and people make room. Raises UserError in a wall."""
        if (why := self.why_not(pose)) is not None:
            raise UserError(why)
        self._make_room(pose)
        self.physics.place(pose)
        self._velocity, self._command = np.zeros(3), None
        # What stands around the new place, for a command that comes before the next scan; no noise is drawn.
        self._points = safety.scan_points(self._scan(self.setup.scanner.limit(self._see(pose[None])[0])))

    def _make_room(self, pose: Array, world: World | None = None) -> None:
        if self.people is not None:
            self.people.make_room(pose[:2], world)
            self.physics.move_people(self.people.places)

    def change(self, action: str, name: str, obstacle: Obstacle | None) -> None:
        """Add, move or remove furniture; raises UserError with the reason where it cannot be."""
        known = {o.name: o for o in self.world.obstacles}
        if (name in known) == (action == "add"):
            there = ", ".join(known) or "none"
            raise UserError(f"there is {'already an' if action == 'add' else 'no'} obstacle {name!r} (there: {there})")
        if not name or name == "boundary":
            raise UserError(f"an obstacle needs a name of its own, not {name!r}")
        if action != "remove":
            if obstacle is None:
                raise UserError(f"{action} needs the obstacle's shape")
            self._check_place(obstacle)
        kept = [o for o in self.world.obstacles if o.name != name]
        if action != "remove" and obstacle is not None:
            obstacle = obstacle.model_copy(update={"name": name})
            kept.append(obstacle)
        # Built anew, for a copy would keep the old world's cached geometry; first, for it may refuse.
        world = self.world.with_obstacles(kept)
        self._make_room(self.physics.pose(), world)
        if action != "add":
            self.physics.remove(name)
        if action != "remove" and obstacle is not None:
            self.physics.add(name, obstacle)
        self.world = world

    def _check_place(self, obstacle: Obstacle) -> None:
        shape = obstacle.shape()
        if not shapely.intersects(shapely.Polygon(self.world.boundary), shape):
            raise UserError("the obstacle would stand outside the world")
        if shapely.distance(shape, shapely.Point(self.physics.pose()[:2])) < self.setup.robot.radius:
            raise UserError("the obstacle would stand on the robot")


def _named(world: World) -> World:
    """Every obstacle with a name, so that it can be moved."""
    taken = [o.name for o in world.obstacles if o.name]
    if twice := sorted({name for name in taken if taken.count(name) > 1}):
        raise UserError(f"world {world.name!r}: two obstacles are named {twice[0]!r}; give each a name of its own")
    if "boundary" in taken:
        raise UserError(
            f"world {world.name!r}: an obstacle is named 'boundary', as the walls are; give it another name"
        )
    free = (name for number in itertools.count() if (name := f"obstacle-{number}") not in taken)
    named = [o if o.name else o.model_copy(update={"name": next(free)}) for o in world.obstacles]
    return world.with_obstacles(named)
