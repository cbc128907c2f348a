"""The world and the robot's body in pybullet: contacts and rays."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pybullet

from common.geometry import se2
from common.geometry.se2 import Array
from common.geometry.world import Obstacle, World
from common.robot.base import Robot

SUBSTEP = 1 / 240  # s
RADIUS = 0.27  # m, of robot.urdf
LASER_HEIGHT = 0.1  # m
WALL_HEIGHT = 0.5  # m, from below the floor, so that no ray sees an edge
CIRCLE_CORNERS = 360  # 0.02 mm off at a radius of 0.5 m
TILE = 10.0  # m; walls of one tile are in one body where they can be
WALLS_A_BODY = 8000  # pybullet takes meshes of up to 131 072 points
END = 0.1  # m, length of a wall's first and last piece
RAYS_A_CALL = 16_000  # pybullet takes 16 384
MOTOR_FORCE = (300.0, 300.0, 100.0)  # N, N, N m: ten times what the limits of acceleration need
WORLD_GROUP, ROBOT_GROUP, PEOPLE_GROUP = 1, 2, 4  # rays see groups they name, never the body they start in


class Physics:
    """Bodies and motion. Poses are of base_link in map."""

    def __init__(self, world: World, robot: Robot, pose: Array) -> None:
        """Build everything; call `close` at the end."""
        self.client = pybullet.connect(pybullet.DIRECT)
        self.robot = robot
        p = pybullet
        p.setPhysicsEngineParameter(fixedTimeStep=SUBSTEP, deterministicOverlappingPairs=1, physicsClientId=self.client)
        with _urdf(robot.radius) as path:
            self.body = p.loadURDF(str(path), useFixedBase=True, physicsClientId=self.client)
        # What the motors are made for, or what this base's limits ask.
        stronger = max(1.0, robot.acceleration, robot.turn_acceleration / 3)
        self._forces = [stronger * force for force in MOTOR_FORCE]
        for link in range(-1, p.getNumJoints(self.body, physicsClientId=self.client)):
            touches = WORLD_GROUP | PEOPLE_GROUP
            p.setCollisionFilterGroupMask(self.body, link, ROBOT_GROUP, touches, physicsClientId=self.client)
        self.shapes: dict[str, int] = {}
        self.people: list[int] = []
        if world.grid is None:
            self._add_ring("boundary", np.array(world.boundary))
        else:
            self._add_walls(world.grid.shapes.walls)
        self.place(pose)

    def close(self) -> None:
        """Give the client back."""
        pybullet.disconnect(physicsClientId=self.client)

    def add(self, name: str, obstacle: Obstacle) -> None:
        """Put a piece of furniture into the world."""
        if obstacle.circle is not None:
            self._add_ring(name, np.array(obstacle.circle.center) + _round(obstacle.circle.radius))
        else:
            ring = obstacle.ring()
            assert ring is not None  # noqa: S101 - not a circle
            self._add_ring(name, ring)

    def remove(self, name: str) -> None:
        """Take a piece of furniture away."""
        pybullet.removeBody(self.shapes.pop(name), physicsClientId=self.client)

    def add_people(self, places: Array, radius: float) -> None:
        """Round bodies at ``places`` (K, 2) m that touch the robot alone; one shape for all."""
        shape = self._shape(_round(radius))
        for x, y in places.tolist():
            body = pybullet.createMultiBody(0, shape, basePosition=[x, y, 0.0], physicsClientId=self.client)
            # Group 1 is a ray's own.
            pybullet.setCollisionFilterGroupMask(
                body, -1, PEOPLE_GROUP, WORLD_GROUP | ROBOT_GROUP, physicsClientId=self.client
            )
            self.people.append(body)

    def move_people(self, places: Array) -> None:
        """Put them at ``places`` (K, 2) m."""
        for body, (x, y) in zip(self.people, places.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(body, [x, y, 0.0], [0, 0, 0, 1], physicsClientId=self.client)

    def _add_ring(self, name: str, ring: Array) -> None:
        """Walls along a closed ring (V, 2) m."""
        self.shapes[name] = self._body(self._shape(ring))

    def _add_walls(self, segments: Array) -> None:
        """Walls along (S, 4) x0, y0, x1, y1 m, which stay: some bodies, each of those near each other."""
        pieces = _split_ends(segments)
        tile = np.floor((pieces[:, :2] + pieces[:, 2:]) / 2 / TILE)
        pieces = pieces[np.lexsort((tile[:, 0], tile[:, 1]))]
        for begin in range(0, len(pieces), WALLS_A_BODY):
            part = pieces[begin : begin + WALLS_A_BODY]
            points, first = part.reshape(-1, 2), 2 * np.arange(len(part))
            self._body(self._mesh(points, np.stack([first, first + 1], axis=-1)))

    def _body(self, shape: int) -> int:
        body: int = pybullet.createMultiBody(0, shape, physicsClientId=self.client)
        pybullet.setCollisionFilterGroupMask(
            body, -1, WORLD_GROUP, WORLD_GROUP | ROBOT_GROUP, physicsClientId=self.client
        )
        return body

    def _shape(self, ring: Array) -> int:
        """A closed ring (V, 2) m as triangles: rays and contacts are exact, concave rings too."""
        ring = _with_short_ends(ring)
        number = np.arange(len(ring))
        return self._mesh(ring, np.stack([number, np.roll(number, -1)], axis=-1))

    def _mesh(self, points: Array, ends: npt.NDArray[np.int_]) -> int:
        """Upright walls between points (V, 2) m of those numbers (W, 2)."""
        count = len(points)
        low, high = (np.column_stack([points, np.full(count, z)]) for z in (-WALL_HEIGHT, WALL_HEIGHT))
        i, j = ends.T
        walls = np.concatenate([np.stack([i, j, j + count], -1), np.stack([i, j + count, i + count], -1)])
        shape: int = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=np.concatenate([low, high]).tolist(),
            indices=walls.ravel().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=self.client,
        )
        return shape

    def place(self, pose: Array) -> None:
        """Carry the robot to a pose (3,), standing."""
        for joint in range(3):
            pybullet.resetJointState(self.body, joint, float(pose[joint]), 0.0, physicsClientId=self.client)

    def pose(self) -> Array:
        """(3,) where the robot is."""
        states = pybullet.getJointStates(self.body, [0, 1, 2], physicsClientId=self.client)
        x, y, yaw = (state[0] for state in states)
        return np.array([x, y, float(se2.wrap(yaw))])

    def twist(self) -> Array:
        """(3,) its velocity in base_link."""
        states = pybullet.getJointStates(self.body, [0, 1, 2], physicsClientId=self.client)
        vx, vy, wz = (state[1] for state in states)
        return np.array([*se2.rotate(-states[2][0], [vx, vy]), wz])

    def drive(self, twist: Array) -> bool:
        """One substep with the wheels at ``twist`` (3,) in base_link; whether the body touched something."""
        yaw = pybullet.getJointState(self.body, 2, physicsClientId=self.client)[0]
        target = [*se2.rotate(yaw, twist[:2]).tolist(), float(twist[2])]
        pybullet.setJointMotorControlArray(
            self.body,
            [0, 1, 2],
            pybullet.VELOCITY_CONTROL,
            targetVelocities=target,
            forces=self._forces,
            physicsClientId=self.client,
        )
        pybullet.stepSimulation(physicsClientId=self.client)
        contacts: Any = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        return any(contact[8] <= 0 or contact[9] > 0 for contact in contacts)

    def ranges(self, lasers: Array, angles: Array, reach: float, *, people: bool = True) -> Array:
        """(N, B) m from laser poses (N, 3) in map along ``angles`` (B,); +inf where nothing is hit within ``reach``.

        Without ``people``, as if none were there.
        """
        heading = (lasers[:, 2:3] + angles).ravel()
        origin = np.column_stack([np.repeat(lasers[:, :2], len(angles), axis=0), np.full(len(heading), LASER_HEIGHT)])
        end = origin + reach * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))])
        found = np.empty(len(heading))
        for start in range(0, len(heading), RAYS_A_CALL):
            part = slice(start, start + RAYS_A_CALL)
            hits = pybullet.rayTestBatch(
                origin[part].tolist(),
                end[part].tolist(),
                numThreads=1,
                collisionFilterMask=WORLD_GROUP | PEOPLE_GROUP if people else WORLD_GROUP,
                physicsClientId=self.client,
            )
            found[part] = [hit[2] if hit[0] >= 0 else np.inf for hit in hits]
        return (found * reach).reshape(len(lasers), len(angles))


@contextmanager
def _urdf(radius: float) -> Iterator[Path]:
    """The base's description with a footprint of ``radius`` m; pybullet reads nothing but files."""
    shipped = Path(__file__).with_name("robot.urdf")
    if radius == RADIUS:
        yield shipped
        return
    text = shipped.read_text(encoding="utf-8").replace(f'radius="{RADIUS}"', f'radius="{radius}"')
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield Path(file.name)


def _round(radius: float) -> Array:
    """(V, 2) m around the origin, between inscribed and circumscribed, so that the error has no sign."""
    angle = np.arange(CIRCLE_CORNERS) * 2 * np.pi / CIRCLE_CORNERS
    return radius * (1 + (np.pi / CIRCLE_CORNERS) ** 2 / 4) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _with_short_ends(ring: Array) -> Array:
    """The ring (V, 2) m with points ``END`` m from every corner of a longer wall.

    Bullet's ray test lets a triangle reach 1e-4 of its length over its edge (btTriangleRaycastCallback), which a ray
    sees at a silhouette: 0.6 mm for a wall of 6 m, 0.01 mm for a short piece.
    """
    points: list[Array] = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        length = float(np.hypot(*(b - a)))
        points.append(a)
        if length > 3 * END:
            points += [a + (b - a) * END / length, b - (b - a) * END / length]
    return np.array(points)


def _split_ends(segments: Array) -> Array:
    """(T, 4): `_with_short_ends` for segments (S, 4) m of their own."""
    along = segments[:, 2:] - segments[:, :2]
    length = np.hypot(*along.T)[:, None]
    longer = length[:, 0] > 3 * END
    first = (segments[:, :2] + along * END / length)[longer]
    last = (segments[:, 2:] - along * END / length)[longer]
    ends = segments[longer]
    pieces = (np.hstack([ends[:, :2], first]), np.hstack([first, last]), np.hstack([last, ends[:, 2:]]))
    return np.concatenate([segments[~longer], *pieces])
