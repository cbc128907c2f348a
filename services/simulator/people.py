"""Walking people as moving discs.

The model. A person is a disc that walks a shortest way over free space (`Floor`) at a given speed to a random place,
then to the next. They see all around, at once, and through walls:

- nobody takes a step that brings them nearer to another than ``KEEP`` between the two bodies;
- nobody takes a step towards the robot, or towards the stretch it covers within ``FORESIGHT`` at its velocity, while
  either is within ``SIDE`` of the next ``LOOK`` metres of their way: they let a robot pass, and never step out before
  one that cannot brake any more;
- who cannot step waits, and after a few seconds chooses another destination, by a way that goes round everybody and the
  robot as they stand then. Who finds none waits again.

So people never touch each other or a wall, and touch the robot only where it drives into them. They do not block each
other for ever: a jam ends with the first whose new way is free, and each draws how long they wait.

Limits. They start and stop within one step, hold no conversation, sit nowhere, form no groups, and do not swerve for
somebody they meet: they stop first. The robot's stretch is straight, so a robot in a curve may come nearer. One that
drives backwards, blind, is trusted as far as one that looks. A passage narrower than body, ``SPARE`` and the grid of
`Floor` together is closed to them, and no one begins in a pocket of less than a square metre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.geometry.world import World
from services.simulator.walkable_grid import Floor, to_segment

RADIUS = 0.25  # m
KEEP = 0.1  # m between two people
SIDE = 0.1  # m between a person who passes and the robot
LOOK = 0.4  # m of the way ahead; with SIDE, half a metre between a person and a robot that stands in their way
FORESIGHT = 1.0  # s of the robot's motion; it brakes from 1 m/s within 0.65 m
PATIENCE = (1.5, 4.0)  # s, how long somebody waits is drawn between these
APART = 1.5  # m between the robot and where somebody is placed
_LOOKS = np.linspace(0.0, LOOK, 5)


@dataclass
class _Walk:
    """A way and how far it has been gone."""

    way: Array  # (W, 2) m
    done: float = 0.0  # m
    waited: float = 0.0  # s, without a step
    patience: float = 0.0  # s

    def __post_init__(self) -> None:
        steps = np.hypot(*np.diff(self.way, axis=0).T)
        self.length = float(steps.sum())
        # Who stops at the end looks on all the same.
        beyond = self.way[-1] + (self.way[-1] - self.way[-2]) * (LOOK / steps[-1] if steps[-1] > 0 else 0.0)
        self._points = np.vstack([self.way, beyond])
        self._at = np.concatenate([[0.0], np.cumsum(steps), [self.length + LOOK]])  # (W + 1,) m along the way

    @property
    def ended(self) -> bool:
        return self.done >= self.length - 1e-9

    def places(self, done: Array) -> Array:
        """(L, 2) m, where ``done`` (L,) m lead."""
        return np.column_stack([np.interp(done, self._at, self._points[:, k]) for k in (0, 1)])


class People:
    """All of them; the same world, seed and robot, the same steps."""

    def __init__(
        self,
        world: World,
        count: int,
        speed: float,
        rng: np.random.Generator,
        robot: Array,
        robot_radius: float,
        radius: float = RADIUS,
    ) -> None:
        """``speed`` m/s; ``robot`` (2,) m where it stands. Raises UserError where the world has no room for them."""
        self.speed, self.radius = speed, radius
        self._rng, self._robot_radius = rng, robot_radius
        self._floor = Floor(world, radius)
        self.places = self._somewhere(self._floor, world, np.zeros((0, 2)), count, robot)  # (K, 2) m in map
        self._walks = [self._standing(place) for place in self.places]

    def step(self, seconds: float, robot: Array, velocity: Array) -> None:
        """One after another walks on; ``robot`` (2,) m where it is and ``velocity`` (2,) m/s, both in map."""
        stretch = robot, robot + velocity * FORESIGHT
        for number in range(len(self.places)):
            self._step(number, seconds, stretch)

    def _step(self, number: int, seconds: float, stretch: tuple[Array, Array]) -> None:
        walk = self._walks[number]
        if walk.ended and walk.waited == 0:
            walk = self._set_out(number, None)
        done = min(walk.done + self.speed * seconds, walk.length)
        ahead = walk.places(done + _LOOKS)
        if not walk.ended and self._may(self.places[number], ahead, stretch):
            walk.done, walk.waited = done, 0.0
            self.places[number] = ahead[0]
            return
        walk.waited += seconds
        if walk.waited >= walk.patience:
            self._set_out(number, stretch[0])

    def _may(self, here: Array, ahead: Array, stretch: tuple[Array, Array]) -> bool:
        """Whether the step from ``here`` (2,) to the first of ``ahead`` (L, 2) is clear of people and robot."""
        off = self.places - here, self.places - ahead[0]
        before, after = np.hypot(off[0][:, 0], off[0][:, 1]), np.hypot(off[1][:, 0], off[1][:, 1])
        # Themselves included: they are 0 away from where they are, and no nearer after a step.
        if ((after < self._apart) & (after < before)).any():
            return False
        places = np.vstack([here, ahead])
        gap = to_segment(places, *stretch)
        if gap[1:].min() >= self._clear_of_robot:
            return True
        straight = np.hypot(*(places[:2] - stretch[0]).T)
        return bool(gap[1] >= gap[0] - 1e-9 and straight[1] >= straight[0] - 1e-9)

    @property
    def _apart(self) -> float:
        """M between the centres of two people."""
        return 2 * self.radius + KEEP

    @property
    def _clear_of_robot(self) -> float:
        """M between the centres of a person who passes and the robot."""
        return self.radius + self._robot_radius + SIDE

    def _standing(self, place: Array) -> _Walk:
        """At the end of a way."""
        return _Walk(np.stack([place, place]), patience=float(self._rng.uniform(*PATIENCE)))

    def _set_out(self, number: int, robot: Array | None) -> _Walk:
        """A new way; round everybody and the ``robot`` (2,) where it is given. The old one where there is none."""
        place, blocked = self.places[number], np.zeros((0, 3))
        if robot is not None:
            others = np.delete(self.places, number, axis=0)
            blocked = np.vstack([np.insert(others, 2, self._apart, axis=1), [*robot, self._clear_of_robot]])
        way = self._floor.way(place, self._rng, blocked)
        walk = self._walks[number]
        if way is not None:
            walk = _Walk(way)
        walk.waited, walk.patience = 0.0, float(self._rng.uniform(*PATIENCE))
        self._walks[number] = walk
        return walk

    def make_room(self, robot: Array, world: World | None = None) -> None:
        """The robot was put down at ``robot`` (2,) m, or furniture changed: who stands in the way is placed anew.

        Raises UserError where there is no room for them; nothing has changed then.
        """
        floor = self._floor if world is None else Floor(world, self.radius)
        clear = np.hypot(*(self.places - robot).T) >= self._clear_of_robot
        stay = np.array([ok and floor.holds(place) for place, ok in zip(self.places, clear, strict=True)], bool)
        places = self.places.copy()
        places[~stay] = self._somewhere(floor, world, places[stay], int((~stay).sum()), robot)
        self._floor, self.places = floor, places
        for number in range(len(places)):
            if world is not None or not stay[number]:
                self._walks[number] = self._standing(places[number])

    def _somewhere(self, floor: Floor, world: World | None, taken: Array, count: int, robot: Array) -> Array:
        """(count, 2) m random free places, clear of those ``taken`` (T, 2) and of each other."""
        found = list(taken)
        for node in self._rng.permutation(floor.roomy) if count else ():
            place = floor.nodes[node]
            clear = not found or float(np.hypot(*(np.array(found) - place).T).min()) >= self._apart
            if clear and float(np.hypot(*(place - robot))) >= APART:
                found.append(place)
                if len(found) == len(taken) + count:
                    break
        if len(found) < len(taken) + count:
            where = f"world {world.name!r}" if world is not None else "the world"
            raise UserError(
                f"{where} has room for {len(found)} people, {APART:g} m from the robot, not for {len(taken) + count}: "
                "ask for fewer (--people)"
            )
        return np.array(found[len(taken) :]).reshape(-1, 2)
