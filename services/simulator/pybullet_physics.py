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
from common.robot.robot import Robot
from services.simulator.physics import SUBSTEP_S

URDF_RADIUS_M = 0.27  # of the footprint in robot.urdf
LASER_HEIGHT_M = 0.1
WALL_HEIGHT_M = 0.5  # above the floor and below it, so that no ray meets an edge
CIRCLE_CORNERS = 360  # accurate to 0.02 mm at a radius of 0.5 m
TILE_M = 10.0  # walls are grouped into bodies tile by tile
MAX_WALLS_PER_BODY = 8000  # pybullet allows meshes of up to 131 072 points
END_PIECE_M = 0.1  # length of a wall's first and last piece
MAX_RAYS_PER_CALL = 16_000  # pybullet allows 16 384
MOTOR_FORCE = (300.0, 300.0, 100.0)  # N, N, N m: ten times what the default acceleration limits need
# Collision groups. A ray hits only the groups in its mask, and never the body inside which it starts.
WORLD_GROUP, ROBOT_GROUP, PEOPLE_GROUP = 1, 2, 4


class PybulletPhysics:
    """Physics by pybullet. The world's walls, furniture and people are pybullet bodies."""

    def __init__(self, world: World, robot: Robot, pose: Array) -> None:
        """Builds the world and puts the robot at ``pose`` (3,). Call `close` at the end."""
        self.client = pybullet.connect(pybullet.DIRECT)
        self.robot = robot
        p = pybullet
        p.setPhysicsEngineParameter(
            fixedTimeStep=SUBSTEP_S, deterministicOverlappingPairs=1, physicsClientId=self.client
        )
        with _urdf(robot.radius) as path:
            self.body = p.loadURDF(str(path), useFixedBase=True, physicsClientId=self.client)
        # A base with higher acceleration limits than the default gets stronger motors.
        strength = max(1.0, robot.acceleration, robot.turn_acceleration / 3)
        self._forces = [strength * force for force in MOTOR_FORCE]
        for link in range(-1, p.getNumJoints(self.body, physicsClientId=self.client)):
            mask = WORLD_GROUP | PEOPLE_GROUP
            p.setCollisionFilterGroupMask(self.body, link, ROBOT_GROUP, mask, physicsClientId=self.client)
        self.shapes: dict[str, int] = {}  # bodies of the furniture by name
        self.people: list[int] = []  # bodies
        if world.grid is None:
            for ring in world.wall_rings:
                self._body(self._shape(np.array(ring)))
        else:
            self._add_walls(world.grid.geometry.walls)
        self.place(pose)

    def close(self) -> None:
        """See Physics."""
        pybullet.disconnect(physicsClientId=self.client)

    def add(self, name: str, obstacle: Obstacle) -> None:
        """See Physics."""
        if obstacle.circle is not None:
            self._add_ring(name, np.array(obstacle.circle.center) + _circle(obstacle.circle.radius))
        else:
            ring = obstacle.ring()
            assert ring is not None  # noqa: S101 - not a circle
            self._add_ring(name, ring)

    def remove(self, name: str) -> None:
        """See Physics."""
        pybullet.removeBody(self.shapes.pop(name), physicsClientId=self.client)

    def add_people(self, places: Array, radius: float) -> None:
        """See Physics."""
        shape = self._shape(_circle(radius))
        for x, y in places.tolist():
            body = pybullet.createMultiBody(0, shape, basePosition=[x, y, 0.0], physicsClientId=self.client)
            # The mask contains WORLD_GROUP because rays belong to group 1.
            pybullet.setCollisionFilterGroupMask(
                body, -1, PEOPLE_GROUP, WORLD_GROUP | ROBOT_GROUP, physicsClientId=self.client
            )
            self.people.append(body)

    def move_people(self, places: Array) -> None:
        """See Physics."""
        for body, (x, y) in zip(self.people, places.tolist(), strict=True):
            pybullet.resetBasePositionAndOrientation(body, [x, y, 0.0], [0, 0, 0, 1], physicsClientId=self.client)

    def _add_ring(self, name: str, ring: Array) -> None:
        """Adds walls along a closed ring (V, 2) m."""
        self.shapes[name] = self._body(self._shape(ring))

    def _add_walls(self, segments: Array) -> None:
        """Adds walls along segments (S, 4) x0, y0, x1, y1 m, as a few bodies of walls that are near each other."""
        pieces = _split_ends(segments)
        tile = np.floor((pieces[:, :2] + pieces[:, 2:]) / 2 / TILE_M)
        pieces = pieces[np.lexsort((tile[:, 0], tile[:, 1]))]
        for begin in range(0, len(pieces), MAX_WALLS_PER_BODY):
            part = pieces[begin : begin + MAX_WALLS_PER_BODY]
            points, first = part.reshape(-1, 2), 2 * np.arange(len(part))
            self._body(self._mesh(points, np.stack([first, first + 1], axis=-1)))

    def _body(self, shape: int) -> int:
        body: int = pybullet.createMultiBody(0, shape, physicsClientId=self.client)
        pybullet.setCollisionFilterGroupMask(
            body, -1, WORLD_GROUP, WORLD_GROUP | ROBOT_GROUP, physicsClientId=self.client
        )
        return body

    def _shape(self, ring: Array) -> int:
        """Collision shape of walls along a closed ring (V, 2) m, which may be concave."""
        ring = _with_short_ends(ring)
        index = np.arange(len(ring))
        return self._mesh(ring, np.stack([index, np.roll(index, -1)], axis=-1))

    def _mesh(self, points: Array, ends: npt.NDArray[np.int_]) -> int:
        """Collision shape of upright walls between pairs of points (V, 2) m, given by their indices (W, 2)."""
        count = len(points)
        low, high = (np.column_stack([points, np.full(count, z)]) for z in (-WALL_HEIGHT_M, WALL_HEIGHT_M))
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
        """See Physics."""
        for joint in range(3):
            pybullet.resetJointState(self.body, joint, float(pose[joint]), 0.0, physicsClientId=self.client)

    def pose(self) -> Array:
        """See Physics."""
        states = pybullet.getJointStates(self.body, [0, 1, 2], physicsClientId=self.client)
        x, y, yaw = (state[0] for state in states)
        return np.array([x, y, float(se2.wrap(yaw))])

    def twist(self) -> Array:
        """See Physics."""
        states = pybullet.getJointStates(self.body, [0, 1, 2], physicsClientId=self.client)
        vx, vy, wz = (state[1] for state in states)
        return np.array([*se2.rotate(-states[2][0], [vx, vy]), wz])

    def drive(self, twist: Array) -> bool:
        """See Physics."""
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
        return any(contact[8] <= 0 or contact[9] > 0 for contact in contacts)  # distance in m, normal force in N

    def ranges(self, lasers: Array, angles: Array, reach: float, *, people: bool = True) -> Array:
        """See Physics."""
        heading = (lasers[:, 2:3] + angles).ravel()
        origin = np.column_stack([np.repeat(lasers[:, :2], len(angles), axis=0), np.full(len(heading), LASER_HEIGHT_M)])
        end = origin + reach * np.column_stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))])
        fraction = np.empty(len(heading))  # of the reach; inf without a hit
        for start in range(0, len(heading), MAX_RAYS_PER_CALL):
            part = slice(start, start + MAX_RAYS_PER_CALL)
            hits = pybullet.rayTestBatch(
                origin[part].tolist(),
                end[part].tolist(),
                numThreads=1,
                collisionFilterMask=WORLD_GROUP | PEOPLE_GROUP if people else WORLD_GROUP,
                physicsClientId=self.client,
            )
            fraction[part] = [hit[2] if hit[0] >= 0 else np.inf for hit in hits]
        return (fraction * reach).reshape(len(lasers), len(angles))


@contextmanager
def _urdf(radius: float) -> Iterator[Path]:
    """The robot's URDF file with a footprint of ``radius`` m. pybullet can only read files."""
    shipped = Path(__file__).with_name("robot.urdf")
    if radius == URDF_RADIUS_M:
        yield shipped
        return
    text = shipped.read_text(encoding="utf-8").replace(f'radius="{URDF_RADIUS_M}"', f'radius="{radius}"')
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        yield Path(file.name)


def _circle(radius: float) -> Array:
    """Polygon (V, 2) m around the origin, between inscribed and circumscribed, so that the mean error is zero."""
    angle = np.arange(CIRCLE_CORNERS) * 2 * np.pi / CIRCLE_CORNERS
    return radius * (1 + (np.pi / CIRCLE_CORNERS) ** 2 / 4) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _with_short_ends(ring: Array) -> Array:
    """The ring (V, 2) m with additional points at ``END_PIECE_M`` from both ends of every long wall.

    In Bullet's ray test a triangle extends over its edge by 1e-4 of its length (btTriangleRaycastCallback). Rays past a
    corner hit that part: 0.6 mm for a wall of 6 m, but only 0.01 mm for a short end piece.
    """
    points: list[Array] = []
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        length = float(np.hypot(*(b - a)))
        points.append(a)
        if length > 3 * END_PIECE_M:
            points += [a + (b - a) * END_PIECE_M / length, b - (b - a) * END_PIECE_M / length]
    return np.array(points)


def _split_ends(segments: Array) -> Array:
    """Segments (T, 4) m: as `_with_short_ends`, for single segments (S, 4) m."""
    along = segments[:, 2:] - segments[:, :2]
    length = np.hypot(*along.T)[:, None]
    longer = length[:, 0] > 3 * END_PIECE_M
    first = (segments[:, :2] + along * END_PIECE_M / length)[longer]
    last = (segments[:, 2:] - along * END_PIECE_M / length)[longer]
    split = segments[longer]
    pieces = (np.hstack([split[:, :2], first]), np.hstack([first, last]), np.hstack([last, split[:, 2:]]))
    return np.concatenate([segments[~longer], *pieces])
