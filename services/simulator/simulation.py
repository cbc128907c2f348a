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
from common.robot.motion_distortion import beam_times, correct_scan
from common.robot.robot import Robot
from common.robot.scanner import Scanner
from common.runtime import safety
from services.simulator.actuator import Actuator
from services.simulator.odometry import Odometer, OdometryNoise
from services.simulator.physics import SUBSTEP_S, Engine, Physics, choose_engine
from services.simulator.recent_motion import MotionState, RecentMotion

if TYPE_CHECKING:
    from services.simulator.people import People

SAMPLE_BLOCK_POSES = 200  # poses whose scans are simulated together


@dataclass(frozen=True)
class SimulationSetup:
    """Parameters of a simulation. Together with the commands they determine a run."""

    world: World
    scanner: Scanner
    robot: Robot = field(default_factory=Robot)
    start: tuple[float, float, float] | None = None  # x m, y m, yaw rad; defaults to the world's start
    seed: int = 0
    drift: OdometryNoise = field(default_factory=OdometryNoise)
    slip: float = 0.0  # mean share of its motion that a wheel loses
    obstacle_stop: bool = True  # off only for fault injection
    sweep: bool = False  # measure one beam after another, as a rotating scanner does, not all at once
    people: int = 0
    people_speed: float = 1.0  # m/s
    engine: Engine = field(default_factory=lambda: choose_engine("auto"))


class Simulation:
    """The simulated robot. The same setup and commands give exactly the same measurements.

    With `SimulationSetup.sweep`, a scan is published when its last beam has been measured, with the stamp of its first
    beam: the physics is ahead of the stamp by the time of a sweep, and a command takes effect as much later.
    """

    def __init__(self, setup: SimulationSetup) -> None:
        """Begins at time 0. Raises UserError if the robot would stand in a wall, or the people have no room."""
        self.setup, self.world = setup, _name_obstacles(setup.world)
        robot, scanner = setup.robot, setup.scanner
        pose = np.array(setup.start) if setup.start is not None else self.world.start_pose(robot.radius)
        if (error := self.placement_error(pose)) is not None:
            raise UserError(f"start {error}")
        # Separate random streams, so that people do not change the noise.
        scan_seed, odom_seed, people_seed, slip_seed = np.random.SeedSequence(setup.seed).spawn(4)
        self.people: People | None = None
        if setup.people:
            # scipy takes half a second to import, and a world without people does not need it.
            from services.simulator.people import People

            people_rng = np.random.default_rng(people_seed)
            self.people = People(self.world, setup.people, setup.people_speed, people_rng, pose[:2], robot.radius)
        self.physics = _create_physics(setup.engine, self.world, robot, pose)
        for obstacle in self.world.obstacles:
            self.physics.add(obstacle.name, obstacle)
        if self.people is not None:
            self.physics.add_people(self.people.places, self.people.radius)
        self._noise = np.random.default_rng(scan_seed)
        self.odometer = Odometer(setup.drift, np.random.default_rng(odom_seed))
        self.substeps = max(1, round(1 / (scanner.rate * SUBSTEP_S)))
        self.steps = 0
        # The scanner turns once per period.
        self._time_increment = scanner.turn_per_beam * self.period_ns * 1e-9 if setup.sweep else 0.0
        self._beam_times = beam_times(scanner.beams, self._time_increment)  # s after the stamp
        self._motion = RecentMotion(self.physics.pose(), self.substeps, SUBSTEP_S)
        self._actuator = Actuator(robot, setup.slip, np.random.default_rng(slip_seed))
        self._command: tuple[int, Array] | None = None  # stamp and velocity of the latest command
        self._last_command_step = 0  # value of `steps` when a command with a new stamp last arrived
        # s of simulated time; longer than the robot's if time passes faster than on the controller's clock
        self.command_timeout_s = robot.command_timeout
        self._contact = self._stopped = False
        self._scan_points = np.zeros((0, 2))  # m in base_link

    def close(self) -> None:
        """Releases the physics engine."""
        self.physics.close()

    @property
    def period_ns(self) -> int:
        """Time between scans."""
        return round(self.substeps * SUBSTEP_S * 1e9)

    @property
    def stamp_ns(self) -> int:
        """Simulated time."""
        return self.steps * self.period_ns

    @property
    def answered(self) -> bool:
        """Whether the present scan's command has arrived."""
        return self._command is not None and self._command[0] == self.stamp_ns

    def command(self, stamp_ns: int, twist: Twist) -> bool:
        """Stores a command; returns False if its stamp is in the future, too old, or older than that of the latest."""
        age_ns, latest_ns = self.stamp_ns - stamp_ns, -1 if self._command is None else self._command[0]
        if age_ns < 0 or age_ns > self.setup.robot.command_age * 1e9 or stamp_ns < latest_ns:
            return False
        if stamp_ns > latest_ns:  # a repeated command does not restart the timeout
            self._last_command_step = self.steps
        self._command = (stamp_ns, safety.clip_twist(twist.array(), self.setup.robot))
        return True

    def advance(self) -> None:
        """Simulates one scan period."""
        silence_s = (self.steps - self._last_command_step) * self.period_ns * 1e-9
        timed_out = silence_s >= self.command_timeout_s
        target = np.zeros(3) if timed_out else self._target_velocity()
        before, measured = self._at_stamp().wheels, self._motion.now.wheels
        self._move_people(self.physics.pose())
        self._contact = False
        self._actuator.set_target(target, at_once=timed_out)
        for _ in range(self.substeps):
            wheels, velocity = self._actuator.step(SUBSTEP_S, hard=timed_out)
            self._contact |= self.physics.drive(velocity)
            pose = self.physics.pose()
            measured = se2.compose(measured, wheels * SUBSTEP_S) if self.setup.slip else pose
            self._motion.add(pose, measured, self.physics.twist())
        self.odometer.move(before, self._at_stamp().wheels)
        self.steps += 1

    def _at_stamp(self) -> MotionState:
        """The robot's state at the stamp of the present scan."""
        if not self._time_increment:
            return self._motion.now
        state = self._motion.at(self._beam_times[-1:])
        return MotionState(state.pose[0], state.wheels[0], state.twist[0])

    def _move_people(self, pose: Array) -> None:
        """Moves the people by one scan period; the robot is at ``pose`` (3,)."""
        if self.people is not None:
            velocity = se2.rotate(float(pose[2]), self.physics.twist()[:2])
            self.people.step(self.period_ns * 1e-9, pose[:2], velocity)
            self.physics.move_people(self.people.places)

    def _target_velocity(self) -> Array:
        """Velocity (3,) for the next period: the latest command while it is fresh, limited by the obstacle stop."""
        self._stopped = False
        if self._command is None or self.stamp_ns - self._command[0] > self.setup.robot.command_age * 1e9:
            return np.zeros(3)
        if not self.setup.obstacle_stop:
            return self._command[1]
        # After this period, the robot must still be able to brake without contact; else it brakes now.
        target, self._stopped = safety.limit_velocity(
            self._command[1], self._scan_points, self.setup.robot, self._actuator.velocity, self.period_ns * 1e-9
        )
        return target

    def observe(self) -> tuple[Odom, Truth, Scan]:
        """Measurements at the present time. Each call draws new noise for the scan."""
        state, scanner = self._at_stamp(), self.setup.scanner
        pose, twist = state.pose, state.twist
        exact = self._sweep() if self._time_increment else self._cast_rays(pose[None])[0]
        ranges = scanner.limit(scanner.add_noise(exact, self._noise))
        velocity = Twist(vx=float(twist[0]), vy=float(twist[1]), wz=float(twist[2]))
        odometer = self.odometer
        odom = Odom(
            stamp_ns=self.stamp_ns, pose=Pose.of(odometer.pose), twist=velocity, covariance=odometer.covariance.copy()
        )
        truth = Truth(
            stamp_ns=self.stamp_ns,
            pose=Pose.of(pose),
            twist=velocity,
            contact=self._contact,
            stopped=self._stopped,
            people=np.zeros((0, 2), np.float32) if self.people is None else self.people.places.astype(np.float32),
        )
        scan = self._scan_message(ranges)
        self._scan_points = self._points_now(scan)
        return odom, truth, scan

    def _sweep(self) -> Array:
        """Ranges (B,) m of one sweep, each beam from the pose at its own time, without noise and range limits."""
        beams = self._motion.at(self._beam_times[-1] - self._beam_times).pose
        lasers = se2.compose(beams, np.array(self.setup.scanner.mount))
        lasers[:, 2] += self.setup.scanner.angles()
        return self.physics.ranges(lasers, np.zeros(1), _reach(self.setup.scanner))[:, 0]

    def _points_now(self, scan: Scan) -> Array:
        """End points (K, 2) m of the scan in base_link at the present time, which is after a sweep."""
        if not self._time_increment:
            return safety.scan_points(scan)
        since_stamp = se2.between(self._at_stamp().pose, self._motion.now.pose)
        corrected = correct_scan(scan, since_stamp / self._beam_times[-1])
        return se2.transform(se2.inverse(since_stamp), safety.scan_points(corrected))

    def _scan_message(self, ranges: Array) -> Scan:
        scanner = self.setup.scanner
        return Scan.of_scanner(
            scanner,
            ranges,
            self.stamp_ns,
            scan_time=self.period_ns * 1e-9,
            time_increment=self._time_increment,
            sigma=scanner.sigma,
            sigma_relative=scanner.sigma_relative,
        )

    def _cast_rays(self, poses: Array, scanner: Scanner | None = None, *, people: bool = True) -> Array:
        """Ranges (N, B) m from base_link poses (N, 3), without noise and range limits."""
        scanner = scanner or self.setup.scanner
        lasers = se2.compose(poses, np.array(scanner.mount))
        return self.physics.ranges(lasers, scanner.angles(), _reach(scanner), people=people)

    def sample(self, poses: Array, beams: int | None, noise_seed: int | None) -> Array:
        """Ranges (N, B) m that the scanner would measure from poses (N, 3), for training.

        ``noise_seed`` of None means no noise. People are left out. The run itself, with its noise, is not affected.
        Raises UserError if a pose is inside a wall.
        """
        scanner = self.setup.scanner.with_beams(beams)
        lasers = se2.compose(poses, np.array(scanner.mount))
        for suffix, positions in (("", poses), (" with the laser", lasers)):
            inside = self.world.clearance(positions[:, :2]) <= 0
            if inside.any():
                x, y, _ = poses[int(np.argmax(inside))]
                raise UserError(
                    f"{inside.sum()} of {len(poses)} poses are{suffix} inside a wall or outside,"
                    f" such as ({x:.2f}, {y:.2f})"
                )
        blocks = [
            self._cast_rays(poses[start : start + SAMPLE_BLOCK_POSES], scanner, people=False)
            for start in range(0, len(poses), SAMPLE_BLOCK_POSES)
        ]
        ranges = np.concatenate(blocks) if blocks else np.zeros((0, scanner.beams))
        if noise_seed is not None:
            ranges = scanner.add_noise(ranges, np.random.default_rng(noise_seed))
        return scanner.limit(ranges)

    def placement_error(self, pose: Array) -> str | None:
        """The reason why the robot cannot stand at a pose (3,), or None if it can."""
        return self.world.placement_error(pose, self.setup.robot.radius)

    def teleport(self, pose: Array) -> None:
        """Puts the robot at a pose (3,), at rest. Odometry does not change, and people make room.

        Raises UserError if the robot cannot stand there.
        """
        if (error := self.placement_error(pose)) is not None:
            raise UserError(error)
        self._make_room(pose)
        self.physics.place(pose)
        self._motion.place(self.physics.pose())
        self._actuator.stop()
        self._command = None
        # Obstacles around the new pose, for a command that arrives before the next scan. Draws no noise.
        self._scan_points = self._points_now(
            self._scan_message(self.setup.scanner.limit(self._cast_rays(pose[None])[0]))
        )

    def _make_room(self, pose: Array, world: World | None = None) -> None:
        if self.people is not None:
            self.people.make_room(pose[:2], world)
            self.physics.move_people(self.people.places)

    def change_obstacle(self, action: str, name: str, obstacle: Obstacle | None) -> None:
        """Adds, moves or removes a piece of furniture. Raises UserError if that is not possible."""
        known = [o.name for o in self.world.obstacles]
        there = ", ".join(known) or "none"
        if action == "add" and name in known:
            raise UserError(f"there is already an obstacle {name!r} (there: {there})")
        if action != "add" and name not in known:
            raise UserError(f"there is no obstacle {name!r} (there: {there})")
        if not name or name == "boundary":
            raise UserError(f"an obstacle needs a name of its own, not {name!r}")
        obstacles = [o for o in self.world.obstacles if o.name != name]
        placed: Obstacle | None = None  # None if the obstacle is removed
        if action != "remove":
            if obstacle is None:
                raise UserError(f"{action} needs the obstacle's shape")
            self._check_place(obstacle)
            placed = obstacle.model_copy(update={"name": name})
            obstacles.append(placed)
        # The world is built first, because that may raise an error.
        world = self.world.with_obstacles(obstacles)
        self._make_room(self.physics.pose(), world)
        if name in known:
            self.physics.remove(name)
        if placed is not None:
            self.physics.add(name, placed)
        self.world = world

    def _check_place(self, obstacle: Obstacle) -> None:
        shape = obstacle.shape()
        rooms = [shapely.Polygon(ring) for ring in self.world.wall_rings or [self.world.boundary]]
        if not shapely.intersects(rooms, shape).any():
            raise UserError("the obstacle would stand outside the world")
        if shapely.distance(shape, shapely.Point(self.physics.pose()[:2])) < self.setup.robot.radius:
            raise UserError("the obstacle would stand on the robot")


def _reach(scanner: Scanner) -> float:
    """Slightly more than the maximum range in m, so that near it the noise decides whether there is a return."""
    return scanner.range_max + 6 * float(scanner.deviation(np.array(scanner.range_max))) + 1e-6


def _create_physics(engine: Engine, world: World, robot: Robot, pose: Array) -> Physics:
    """Builds the boundary or the map of ``world`` without its furniture, and puts the robot at ``pose`` (3,)."""
    if engine == "kinematic":
        from services.simulator.kinematics import Kinematics  # slow: numba

        return Kinematics(world, robot, pose)
    from services.simulator.pybullet_physics import PybulletPhysics  # has no wheels on some platforms

    return PybulletPhysics(world, robot, pose)


def _name_obstacles(world: World) -> World:
    """The world with a name for every obstacle, by which it can be moved and removed."""
    taken = {o.name for o in world.obstacles}
    free = (name for number in itertools.count() if (name := f"obstacle-{number}") not in taken)
    named = [o if o.name else o.model_copy(update={"name": next(free)}) for o in world.obstacles]
    return world.with_obstacles(named)
