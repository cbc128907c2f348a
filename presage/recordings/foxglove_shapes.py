"""Foxglove's poses, scans and shapes.

Built with foxglove-schemas-protobuf: Foxglove's own classes, generated from its .proto files, 0.1 MB and pure Python;
foxglove-sdk holds the same schemas beside a server of 54 MB.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.CylinderPrimitive_pb2 import CylinderPrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.Vector2_pb2 import Vector2
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from common.geometry import rasterize as raster
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, Hypothesis, Plan, Prediction, Preference, Scan
from common.robot.ranges import surfaces

TRUTH, BELIEF, GOAL = (0.0, 0.0, 0.0), (0.84, 0.37, 0.0), (0.0, 0.62, 0.45)  # red, green, blue, as in `presage plot`
WALL, FURNITURE = (0.55, 0.55, 0.55), (0.78, 0.78, 0.78)
WALL_HEIGHT, WALL_THICKNESS = 0.5, 0.06  # m, as drawn
NINETY_FIVE = 2.447746830680816  # a Gaussian's 95 % ellipse in the plane: the root of chi² with 2 degrees at 0.95
AXES = (("x", 0), ("y", 4))  # float32 of a point in the plane, and where it begins
FREE, OCCUPIED = (245, 245, 245, 255), (70, 70, 70, 255)  # red, green, blue, alpha; outside stays clear


def time_of(ns: int) -> Timestamp:
    """A time in ns."""
    seconds, nanos = divmod(ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def color(rgb: Sequence[float], alpha: float = 1.0) -> Color:
    """Of 0 to 1."""
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def turn(yaw: float) -> Quaternion:
    """About z, rad."""
    return Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))


def pose(xyyaw: Sequence[float] | Array, z: float = 0.0) -> Pose:
    """From x m, y m, yaw rad."""
    x, y, yaw = map(float, xyyaw)
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=turn(yaw))


def pose_in(frame: str, xyyaw: Array, ns: int) -> PoseInFrame:
    """A pose that stands alone."""
    return PoseInFrame(timestamp=time_of(ns), frame_id=frame, pose=pose(xyyaw))


def transform(parent: str, child: str, xyyaw: Array, ns: int) -> FrameTransform:
    """The pose of ``child`` in ``parent``."""
    x, y, yaw = map(float, xyyaw)
    return FrameTransform(
        timestamp=time_of(ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=0.0),
        rotation=turn(yaw),
    )


def laser_scan(scan: Scan | Prediction, ns: int) -> LaserScan:
    """Measured or predicted ranges in frame laser; what is no distance (±inf, 0) becomes NaN, which nobody draws."""
    ranges = np.where(surfaces(scan.ranges), scan.ranges, np.nan).astype(float)
    return LaserScan(
        timestamp=time_of(ns),
        frame_id="laser",
        pose=pose((0, 0, 0)),
        start_angle=scan.angle_min,
        end_angle=scan.angle_min + scan.angle_increment * max(len(ranges) - 1, 0),
        ranges=ranges.tolist(),
    )


def line(points: Array, rgb: Sequence[float], alpha: float = 1.0, *, closed: bool = False, z: float = 0.02,
         thickness: float = 2.0) -> LinePrimitive:  # fmt: skip
    """Through points (N, 2) m, ``thickness`` pixels on the screen."""
    return LinePrimitive(
        type=LinePrimitive.LINE_LOOP if closed else LinePrimitive.LINE_STRIP,
        pose=pose((0, 0, 0)),
        thickness=thickness,
        scale_invariant=True,
        points=[Point3(x=float(x), y=float(y), z=z) for x, y in points],
        color=color(rgb, alpha),
    )


def ellipse(mean: Array, covariance: Array, sides: int = 48) -> Array:
    """(sides, 2) m, the 95 % ellipse of x and y; mean (3,), covariance (3, 3)."""
    values, axes = np.linalg.eigh(np.asarray(covariance, float)[:2, :2])
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return np.asarray((axes * np.sqrt(np.maximum(values, 0.0)) @ circle).T * NINETY_FIVE + mean[:2], float)


def hypotheses(belief: Belief) -> list[Hypothesis]:
    """The mixture; of an estimator that gives none, its pose with weight 1."""
    return belief.hypotheses or [Hypothesis(pose=belief.pose, covariance=belief.covariance, weight=1.0)]


def belief_entity(belief: Belief, ns: int) -> SceneEntity:
    """An arrow and a 95 % ellipse for each hypothesis, as solid as its weight."""
    entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id="belief", frame_locked=True)
    for hypothesis in hypotheses(belief):
        alpha = 0.15 + 0.85 * hypothesis.weight
        at = hypothesis.pose.array()
        entity.arrows.append(
            ArrowPrimitive(pose=pose(at, 0.05), shaft_length=0.35, shaft_diameter=0.06, head_length=0.15,
                           head_diameter=0.14, color=color(BELIEF, alpha))
        )  # fmt: skip
        if hypothesis.covariance is not None:
            outline = ellipse(at, hypothesis.covariance)
            entity.lines.append(line(outline, BELIEF, alpha, closed=True, z=0.06))
    return entity


def disc(frame: str, name: str, at: Array, radius: float, height: float, rgb: Sequence[float], alpha: float,
         ns: int) -> SceneEntity:  # fmt: skip
    """A flat cylinder: the robot's body, the goal and its tolerance."""
    size = Vector3(x=2 * radius, y=2 * radius, z=height)
    shape = CylinderPrimitive(
        pose=pose(at, height / 2), size=size, bottom_scale=1, top_scale=1, color=color(rgb, alpha)
    )
    return SceneEntity(timestamp=time_of(ns), frame_id=frame, id=name, frame_locked=True, cylinders=[shape])


def plan_entity(plan: Plan, ns: int) -> SceneEntity:
    """The way ahead and where the command leads; one plan replaces the last."""
    entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id="plan", frame_locked=True)
    for points, rgb in ((plan.path, GOAL), (plan.motion, BELIEF)):
        if len(points) > 1:
            entity.lines.append(line(points.astype(float), rgb, 0.8, z=0.04))
    return entity


def obstacle_points(plan: Plan, ns: int) -> PointCloud:
    """What the scan sees and the map does not have."""
    return PointCloud(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose((0, 0, 0), 0.1),
        point_stride=8,
        fields=[PackedElementField(name=name, offset=at, type=PackedElementField.FLOAT32) for name, at in AXES],
        data=np.asarray(plan.obstacles, "<f4").tobytes(),
    )


def preference_grid(preference: Preference, ns: int) -> Grid:
    """Metres to go of each cell, a float32 named distance; infinite where the goal is out of reach."""
    return Grid(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose(preference.origin.array(), -0.005),  # between the map and the rest
        column_count=preference.width,
        cell_size=Vector2(x=preference.resolution, y=preference.resolution),
        row_stride=preference.width * 4,
        cell_stride=4,
        fields=[PackedElementField(name="distance", offset=0, type=PackedElementField.FLOAT32)],
        data=np.asarray(preference.distance, "<f4").tobytes(),
    )


def path_entity(name: str, path: Array, rgb: Sequence[float], ns: int) -> SceneEntity:
    """A whole path (N, 3) in map, without the points that lie within 1 cm of a straight line."""
    points = path[:, :2]
    if len(points) > 2:
        points = shapely.get_coordinates(shapely.simplify(shapely.LineString(points), 0.01))
    shape = line(points, rgb, 0.8)
    return SceneEntity(timestamp=time_of(ns), frame_id="map", id=name, frame_locked=True, lines=[shape])


def world_entities(world: World, ns: int) -> list[SceneEntity]:
    """Walls and furniture in map; their visible faces stand where the world says."""
    walls = SceneEntity(timestamp=time_of(ns), frame_id="map", id="walls", frame_locked=True)
    if world.grid is None:
        walls.cubes.extend(_slabs(np.array(world.boundary), WALL, outside=True))
    else:  # thousands of faces: the top edges, as one shape
        edges = line(world.grid.shapes.walls.reshape(-1, 2), WALL, z=WALL_HEIGHT)
        edges.type = LinePrimitive.LINE_LIST
        walls.lines.append(edges)
    found = [walls]
    for number, obstacle in enumerate(world.obstacles):
        name = f"obstacle {number} {obstacle.name}".rstrip()
        if obstacle.circle is not None:
            at = np.array([*obstacle.circle.center, 0.0])
            found.append(disc("map", name, at, obstacle.circle.radius, WALL_HEIGHT, FURNITURE, 1.0, ns))
            continue
        entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id=name, frame_locked=True)
        if obstacle.box is not None:
            at = np.array([*obstacle.box.center, np.deg2rad(obstacle.box.yaw_deg)])
            entity.cubes.append(_cube(at, obstacle.box.size, FURNITURE))
        elif (ring := obstacle.ring()) is not None:
            entity.cubes.extend(_slabs(ring, FURNITURE, outside=False))
        found.append(entity)
    return found


def _cube(at: Array, size: Iterable[float], rgb: Sequence[float]) -> CubePrimitive:
    x, y = size
    return CubePrimitive(
        pose=pose(at, WALL_HEIGHT / 2), size=Vector3(x=float(x), y=float(y), z=WALL_HEIGHT), color=color(rgb)
    )


def _slabs(ring: Array, rgb: Sequence[float], *, outside: bool) -> list[CubePrimitive]:
    """A slab along each edge of a ring (V, 2), on its outer or inner side."""
    counter_clockwise = shapely.is_ccw(shapely.LinearRing(ring))
    side = WALL_THICKNESS / 2 * (1 if outside == counter_clockwise else -1)
    found = []
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        length, yaw = np.hypot(bx - ax, by - ay), np.arctan2(by - ay, bx - ax)
        middle = np.array([(ax + bx) / 2 + side * np.sin(yaw), (ay + by) / 2 - side * np.cos(yaw), yaw])
        found.append(_cube(middle, (length + (WALL_THICKNESS if outside else 0.0), WALL_THICKNESS), rgb))
    return found


def grid(world: World, ns: int) -> Grid:
    """The map: red, green, blue, alpha and occupancy (0 free, 100 occupied, 255 outside: unknown), a byte each."""
    (x0, y0), cell, x, y = raster.cell_centres(world)
    free, wall = raster.classify_points(world, x, y, cell)
    columns = x.shape[1]
    data = np.zeros((*x.shape, 5), np.uint8)
    data[..., 4] = 255
    data[free], data[wall] = (*FREE, 0), (*OCCUPIED, 100)
    names = ("red", "green", "blue", "alpha", "occupancy")
    return Grid(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose((x0, y0, 0.0), -0.01),  # below the rest
        column_count=columns,
        cell_size=Vector2(x=cell, y=cell),
        row_stride=columns * len(names),
        cell_stride=len(names),
        fields=[
            PackedElementField(name=name, offset=at, type=PackedElementField.UINT8) for at, name in enumerate(names)
        ],
        data=data.tobytes(),
    )
