"""Walking people as moving discs.

Model. A person is a disc that walks at a given speed along a shortest path over free space (`WalkableGrid`) to a
random place, then to the next one. A person always knows the positions of all others, also behind walls. The rules:

- A person takes no step that brings them closer to another person than ``PERSON_GAP_M`` between the two bodies.
- A person takes no step towards the robot, or towards the segment that it covers within ``ROBOT_FORESIGHT_S`` at its
  present velocity, if either comes within ``ROBOT_GAP_M`` of the next ``LOOK_AHEAD_M`` of their path. They let a robot
  pass, and never step in front of one that cannot brake in time.
- A person who cannot step waits. After a few seconds they choose another destination, with a path around all people and
  the robot as they stand then. If there is no such path, they wait again.

People therefore never touch each other or a wall, and touch the robot only if it drives into them. They do not block
each other for ever: each waits for a random time, and a jam ends with the first person whose new path is free.

Limits. People start and stop within one step, do not talk, sit or form groups, and do not swerve around a person who
comes towards them: they stop first. The robot's motion is predicted as straight, so a robot in a curve may come closer.
People do not take into account which way the robot's scanner looks. A passage narrower than the body, margins and the
spacing of `WalkableGrid` together is closed to people, and no person starts in an area of less than one square metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import World
from services.simulator.walkable_grid import WalkableGrid, distance_to_segment

PERSON_RADIUS_M = 0.25
PERSON_GAP_M = 0.1  # between two people
ROBOT_GAP_M = 0.1  # between a person who passes and the robot
LOOK_AHEAD_M = 0.4  # length of the path that must be clear; with ROBOT_GAP_M, people stop 0.5 m before a robot
ROBOT_FORESIGHT_S = 1.0  # people expect the robot to keep its velocity this long; it brakes from 1 m/s within 0.65 m
WAIT_RANGE_S = (1.5, 4.0)  # waiting times are drawn from this interval
MIN_START_DISTANCE_M = 1.5  # between the robot and a place where a person is put
_LOOK_AHEAD_STEPS = np.linspace(0.0, LOOK_AHEAD_M, 5)


@dataclass
class _Walk:
    """A path and the progress along it."""

    path: Array  # (W, 2) m
    walked: float = 0.0  # m
    waited: float = 0.0  # s since the last step
    max_wait: float = 0.0  # s

    def __post_init__(self) -> None:
        steps = np.hypot(*np.diff(self.path, axis=0).T)
        self.length = float(steps.sum())
        # Extended by the look-ahead, which applies to the last steps as well.
        beyond = self.path[-1] + (self.path[-1] - self.path[-2]) * (LOOK_AHEAD_M / steps[-1] if steps[-1] > 0 else 0.0)
        self._points = np.vstack([self.path, beyond])
        # (W + 1,) m along the path at which the points lie.
        self._distances = np.concatenate([[0.0], np.cumsum(steps), [self.length + LOOK_AHEAD_M]])

    @property
    def ended(self) -> bool:
        return self.walked >= self.length - 1e-9

    def places(self, distances: Array) -> Array:
        """Places (L, 2) m at ``distances`` (L,) m along the path."""
        return np.column_stack([np.interp(distances, self._distances, self._points[:, k]) for k in (0, 1)])


class People:
    """All people of a world. The same world, seed and robot motion give the same steps."""

    def __init__(
        self,
        world: World,
        count: int,
        speed: float,
        rng: np.random.Generator,
        robot: Array,
        robot_radius: float,
        radius: float = PERSON_RADIUS_M,
    ) -> None:
        """Puts ``count`` people at random free places.

        ``speed`` is in m/s, ``robot`` (2,) m its position. Raises UserError if the world has no room for them.
        """
        self.speed, self.radius = speed, radius
        self._rng, self._robot_radius = rng, robot_radius
        self._grid = WalkableGrid(world, radius)
        self.places = self._draw_places(self._grid, world, np.zeros((0, 2)), count, robot)  # (K, 2) m in map
        self._walks = [self._standing_at(place) for place in self.places]

    def step(self, seconds: float, robot: Array, velocity: Array) -> None:
        """Moves all people, one after another; ``robot`` (2,) m and its ``velocity`` (2,) m/s are in map."""
        robot_segment = robot, robot + velocity * ROBOT_FORESIGHT_S
        for number in range(len(self.places)):
            self._step(number, seconds, robot_segment)

    def _step(self, number: int, seconds: float, robot_segment: tuple[Array, Array]) -> None:
        walk = self._walks[number]
        if walk.ended and walk.waited == 0:
            walk = self._start_walk(number, None)
        walked = min(walk.walked + self.speed * seconds, walk.length)
        ahead = walk.places(walked + _LOOK_AHEAD_STEPS)
        if not walk.ended and self._may_step(self.places[number], ahead, robot_segment):
            walk.walked, walk.waited = walked, 0.0
            self.places[number] = ahead[0]
            return
        walk.waited += seconds
        if walk.waited >= walk.max_wait:
            self._start_walk(number, robot_segment[0])

    def _may_step(self, here: Array, ahead: Array, robot_segment: tuple[Array, Array]) -> bool:
        """Whether the step from ``here`` (2,) to the first of ``ahead`` (L, 2) keeps the distances."""
        offset_before, offset_after = self.places - here, self.places - ahead[0]
        before, after = np.hypot(*offset_before.T), np.hypot(*offset_after.T)
        # This includes the person, whose distance from their own place is 0 and does not decrease with the step.
        if ((after < self._min_person_distance) & (after < before)).any():
            return False
        places = np.vstack([here, ahead])
        distance = distance_to_segment(places, *robot_segment)
        if distance[1:].min() >= self._min_robot_distance:
            return True
        # Too close to the robot: only a step that leads away is allowed.
        from_robot = np.hypot(*(places[:2] - robot_segment[0]).T)
        return bool(distance[1] >= distance[0] - 1e-9 and from_robot[1] >= from_robot[0] - 1e-9)

    @property
    def _min_person_distance(self) -> float:
        """Between the centres of two people, in m."""
        return 2 * self.radius + PERSON_GAP_M

    @property
    def _min_robot_distance(self) -> float:
        """Between the centres of a person who passes and the robot, in m."""
        return self.radius + self._robot_radius + ROBOT_GAP_M

    def _standing_at(self, place: Array) -> _Walk:
        """A walk of length zero, after which the person sets out at the next step."""
        return _Walk(np.stack([place, place]), max_wait=float(self._rng.uniform(*WAIT_RANGE_S)))

    def _start_walk(self, number: int, robot: Array | None) -> _Walk:
        """Starts a new walk if there is a path; returns the walk in effect.

        With ``robot`` (2,) the path leads around all people and the robot.
        """
        place, blocked = self.places[number], np.zeros((0, 3))
        if robot is not None:
            others = np.delete(self.places, number, axis=0)
            discs = np.insert(others, 2, self._min_person_distance, axis=1)
            blocked = np.vstack([discs, [*robot, self._min_robot_distance]])
        path = self._grid.random_path(place, self._rng, blocked)
        walk = self._walks[number]
        if path is not None:
            walk = _Walk(path)
        walk.waited, walk.max_wait = 0.0, float(self._rng.uniform(*WAIT_RANGE_S))
        self._walks[number] = walk
        return walk

    def make_room(self, robot: Array, world: World | None = None) -> None:
        """Moves people who are in the way after the robot was put at ``robot`` (2,) m, or after furniture changed.

        ``world`` is the world with the changed furniture. Raises UserError, and changes nothing, if there is no room.
        """
        grid = self._grid if world is None else WalkableGrid(world, self.radius)
        clear = np.hypot(*(self.places - robot).T) >= self._min_robot_distance
        stay = np.array([ok and grid.can_start(place) for place, ok in zip(self.places, clear, strict=True)], bool)
        places = self.places.copy()
        places[~stay] = self._draw_places(grid, world, places[stay], int((~stay).sum()), robot)
        self._grid, self.places = grid, places
        for number in range(len(places)):
            if world is not None or not stay[number]:
                self._walks[number] = self._standing_at(places[number])

    def _draw_places(self, grid: WalkableGrid, world: World | None, taken: Array, count: int, robot: Array) -> Array:
        """Random free places (count, 2) m, clear of the robot, of those ``taken`` (T, 2) and of each other."""
        found = list(taken)
        for node in self._rng.permutation(grid.start_nodes) if count else ():
            place = grid.nodes[node]
            clear = not found or float(np.hypot(*(np.array(found) - place).T).min()) >= self._min_person_distance
            if clear and float(np.hypot(*(place - robot))) >= MIN_START_DISTANCE_M:
                found.append(place)
                if len(found) == len(taken) + count:
                    break
        if len(found) < len(taken) + count:
            where = f"world {world.name!r}" if world is not None else "the world"
            raise UserError(
                f"{where} has room for {len(found)} people, {MIN_START_DISTANCE_M:g} m from the robot, "
                f"not for {len(taken) + count}: ask for fewer (--people)"
            )
        return np.array(found[len(taken) :]).reshape(-1, 2)
