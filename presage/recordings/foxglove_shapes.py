"""Foxglove's poses, scans and shapes.

Uses foxglove-schemas-protobuf: the classes that Foxglove generates from its .proto files, 0.1 MB of pure Python.
foxglove-sdk has the same schemas, but comes with a server of 54 MB.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
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

from common.geometry import occupancy_grid, rasterisation
from common.geometry.se2 import Array
from common.geometry.world import World
from common.messages.definitions import Belief, BeliefHypothesis, Map, Plan, Prediction, Preference, Scan
from common.robot.ranges import is_surface

TRUTH, BELIEF, GOAL = (0.0, 0.0, 0.0), (0.84, 0.37, 0.0), (0.0, 0.62, 0.45)  # RGB, as in `presage plot`
WALL, FURNITURE = (0.55, 0.55, 0.55), (0.78, 0.78, 0.78)
WALL_HEIGHT, WALL_THICKNESS = 0.5, 0.06  # m, as drawn
ELLIPSE_SCALE_95 = 2.447746830680816  # of standard deviations; square root of the 0.95 quantile of chi² with 2 degrees
ELLIPSE_SIDES = 48  # of the polygon that is drawn
POINT_FIELDS = (("x", 0), ("y", 4))  # name and offset in bytes of the float32 values of a point
FREE, OCCUPIED = (245, 245, 245, 255), (70, 70, 70, 255)  # RGBA; unknown cells are transparent


def time_of(ns: int) -> Timestamp:
    """A timestamp from ns."""
    seconds, nanos = divmod(ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


def color(rgb: Sequence[float], alpha: float = 1.0) -> Color:
    """A colour from RGB values between 0 and 1."""
    return Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def quaternion(yaw: float) -> Quaternion:
    """The rotation by ``yaw`` rad about z."""
    return Quaternion(x=0.0, y=0.0, z=float(np.sin(yaw / 2)), w=float(np.cos(yaw / 2)))


def pose(xyyaw: Sequence[float] | Array, z: float = 0.0) -> Pose:
    """A pose from (x, y, yaw) in m, m, rad."""
    x, y, yaw = map(float, xyyaw)
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=quaternion(yaw))


def pose_in(frame: str, xyyaw: Array, ns: int) -> PoseInFrame:
    """A pose with frame and time."""
    return PoseInFrame(timestamp=time_of(ns), frame_id=frame, pose=pose(xyyaw))


def transform(parent: str, child: str, xyyaw: Array, ns: int) -> FrameTransform:
    """The transform that is the pose of ``child`` in ``parent``."""
    x, y, yaw = map(float, xyyaw)
    return FrameTransform(
        timestamp=time_of(ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=0.0),
        rotation=quaternion(yaw),
    )


def laser_scan(scan: Scan | Prediction, ns: int) -> LaserScan:
    """Measured or predicted ranges in frame laser; values that are not distances (±inf, 0) become NaN, not drawn."""
    ranges = np.where(is_surface(scan.ranges), scan.ranges, np.nan).astype(float)
    return LaserScan(
        timestamp=time_of(ns),
        frame_id="laser",
        pose=pose((0, 0, 0)),
        start_angle=scan.angle_min,
        end_angle=scan.angle_min + scan.angle_increment * max(len(ranges) - 1, 0),
        ranges=ranges.tolist(),
    )


def line(
    points: Array,
    rgb: Sequence[float],
    alpha: float = 1.0,
    *,
    closed: bool = False,
    z: float = 0.02,
    thickness: float = 2.0,
) -> LinePrimitive:
    """A line through points (N, 2) m; its thickness is in pixels of the screen."""
    return LinePrimitive(
        type=LinePrimitive.LINE_LOOP if closed else LinePrimitive.LINE_STRIP,
        pose=pose((0, 0, 0)),
        thickness=thickness,
        scale_invariant=True,
        points=[Point3(x=float(x), y=float(y), z=z) for x, y in points],
        color=color(rgb, alpha),
    )


def ellipse(mean: Array, covariance: Array) -> Array:
    """Points (ELLIPSE_SIDES, 2) m on the 95 % ellipse of x and y, from a mean (3,) and a covariance (3, 3)."""
    values, axes = np.linalg.eigh(np.asarray(covariance, float)[:2, :2])
    angles = np.linspace(0, 2 * np.pi, ELLIPSE_SIDES, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)])
    return np.asarray((axes * np.sqrt(np.maximum(values, 0.0)) @ circle).T * ELLIPSE_SCALE_95 + mean[:2], float)


def hypotheses(belief: Belief) -> list[BeliefHypothesis]:
    """The hypotheses of a belief; if it has none, its pose with weight 1."""
    return belief.hypotheses or [BeliefHypothesis(pose=belief.pose, covariance=belief.covariance, weight=1.0)]


def belief_entity(belief: Belief, ns: int) -> SceneEntity:
    """An arrow and a 95 % ellipse for each hypothesis, with an opacity that grows with its weight."""
    entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id="belief", frame_locked=True)
    for hypothesis in hypotheses(belief):
        alpha = 0.15 + 0.85 * hypothesis.weight
        xyyaw = hypothesis.pose.array()
        entity.arrows.append(
            ArrowPrimitive(
                pose=pose(xyyaw, 0.05),
                shaft_length=0.35,
                shaft_diameter=0.06,
                head_length=0.15,
                head_diameter=0.14,
                color=color(BELIEF, alpha),
            )
        )
        if hypothesis.covariance is not None:
            outline = ellipse(xyyaw, hypothesis.covariance)
            entity.lines.append(line(outline, BELIEF, alpha, closed=True, z=0.06))
    return entity


def disc(
    frame: str, name: str, centre: Array, radius: float, height: float, rgb: Sequence[float], alpha: float, ns: int
) -> SceneEntity:
    """A flat cylinder at the pose ``centre`` (3,), for the robot's body, the goal and its tolerance."""
    size = Vector3(x=2 * radius, y=2 * radius, z=height)
    shape = CylinderPrimitive(
        pose=pose(centre, height / 2), size=size, bottom_scale=1, top_scale=1, color=color(rgb, alpha)
    )
    return SceneEntity(timestamp=time_of(ns), frame_id=frame, id=name, frame_locked=True, cylinders=[shape])


def plan_entity(plan: Plan, ns: int) -> SceneEntity:
    """The planned path and the motion that the command leads to; a plan replaces the one before."""
    entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id="plan", frame_locked=True)
    for points, rgb in ((plan.path, GOAL), (plan.motion, BELIEF)):
        if len(points) > 1:
            entity.lines.append(line(points.astype(float), rgb, 0.8, z=0.04))
    return entity


def obstacle_points(plan: Plan, ns: int) -> PointCloud:
    """The obstacles that the scan shows and the map does not contain."""
    return PointCloud(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose((0, 0, 0), 0.1),
        point_stride=8,
        fields=[
            PackedElementField(name=name, offset=offset, type=PackedElementField.FLOAT32)
            for name, offset in POINT_FIELDS
        ],
        data=np.asarray(plan.obstacles, "<f4").tobytes(),
    )


def preference_grid(preference: Preference, ns: int) -> Grid:
    """Cost of the path to the goal from each cell, m, as float32 `distance`; infinite if it cannot be reached."""
    return Grid(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose(preference.origin.array(), -0.005),  # above the map and below everything else
        column_count=preference.width,
        cell_size=Vector2(x=preference.resolution, y=preference.resolution),
        row_stride=preference.width * 4,
        cell_stride=4,
        fields=[PackedElementField(name="distance", offset=0, type=PackedElementField.FLOAT32)],
        data=np.asarray(preference.distance, "<f4").tobytes(),
    )


def path_entity(name: str, path: Array, rgb: Sequence[float], ns: int) -> SceneEntity:
    """A path (N, 3) in map, simplified with a tolerance of 1 cm."""
    points = path[:, :2]
    if len(points) > 2:
        points = shapely.get_coordinates(shapely.simplify(shapely.LineString(points), 0.01))
    shape = line(points, rgb, 0.8)
    return SceneEntity(timestamp=time_of(ns), frame_id="map", id=name, frame_locked=True, lines=[shape])


def world_entities(world: World, ns: int) -> list[SceneEntity]:
    """Walls and furniture in map; the thickness of walls extends away from free space."""
    walls = SceneEntity(timestamp=time_of(ns), frame_id="map", id="walls", frame_locked=True)
    for wall in world.wall_rings:
        walls.cubes.extend(_slabs(np.array(wall), WALL, outside=True))
    if world.grid is not None:  # lines instead of cubes, because a ROS map has thousands of walls
        edges = line(world.grid.geometry.walls.reshape(-1, 2), WALL, z=WALL_HEIGHT)
        edges.type = LinePrimitive.LINE_LIST
        walls.lines.append(edges)
    found = [walls]
    for number, obstacle in enumerate(world.obstacles):
        name = f"obstacle {number} {obstacle.name}".rstrip()
        if obstacle.circle is not None:
            centre = np.array([*obstacle.circle.center, 0.0])
            found.append(disc("map", name, centre, obstacle.circle.radius, WALL_HEIGHT, FURNITURE, 1.0, ns))
            continue
        entity = SceneEntity(timestamp=time_of(ns), frame_id="map", id=name, frame_locked=True)
        if obstacle.box is not None:
            centre = np.array([*obstacle.box.center, np.deg2rad(obstacle.box.yaw_deg)])
            entity.cubes.append(_cube(centre, obstacle.box.size, FURNITURE))
        elif (ring := obstacle.ring()) is not None:
            entity.cubes.extend(_slabs(ring, FURNITURE, outside=False))
        found.append(entity)
    return found


def _cube(centre: Array, size: Iterable[float], rgb: Sequence[float]) -> CubePrimitive:
    x, y = size
    return CubePrimitive(
        pose=pose(centre, WALL_HEIGHT / 2), size=Vector3(x=float(x), y=float(y), z=WALL_HEIGHT), color=color(rgb)
    )


def _slabs(ring: Array, rgb: Sequence[float], *, outside: bool) -> list[CubePrimitive]:
    """A thin box along each edge of a ring (V, 2), on its outer or inner side."""
    counter_clockwise = shapely.is_ccw(shapely.LinearRing(ring))
    side = WALL_THICKNESS / 2 * (1 if outside == counter_clockwise else -1)
    found = []
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        length, yaw = np.hypot(bx - ax, by - ay), np.arctan2(by - ay, bx - ax)
        middle = np.array([(ax + bx) / 2 + side * np.sin(yaw), (ay + by) / 2 - side * np.cos(yaw), yaw])
        found.append(_cube(middle, (length + (WALL_THICKNESS if outside else 0.0), WALL_THICKNESS), rgb))
    return found


def grid(world: World, ns: int) -> Grid:
    """The map, with RGBA and occupancy (0 free, 100 occupied, 255 unknown) as one byte each."""
    (x0, y0), cell, x, y = rasterisation.cell_centres(world)
    free, wall = rasterisation.classify_points(world, x, y, cell)
    return _coloured_grid(free, wall, (x0, y0, 0.0), cell, ns)


def grown_map(message: Map, ns: int) -> Grid:
    """The map so far, like `grid`."""
    values = message.grid.values
    return _coloured_grid(
        values == occupancy_grid.FREE,
        values == occupancy_grid.OCCUPIED,
        message.grid.origin,
        message.grid.resolution,
        ns,
    )


def _coloured_grid(
    free: npt.NDArray[np.bool_], wall: npt.NDArray[np.bool_], origin: tuple[float, float, float], cell: float, ns: int
) -> Grid:
    columns = free.shape[1]
    data = np.zeros((*free.shape, 5), np.uint8)
    data[..., 4] = 255
    data[free], data[wall] = (*FREE, 0), (*OCCUPIED, 100)
    names = ("red", "green", "blue", "alpha", "occupancy")
    return Grid(
        timestamp=time_of(ns),
        frame_id="map",
        pose=pose(origin, -0.01),  # below everything else
        column_count=columns,
        cell_size=Vector2(x=cell, y=cell),
        row_stride=columns * len(names),
        cell_stride=len(names),
        fields=[
            PackedElementField(name=name, offset=offset, type=PackedElementField.UINT8)
            for offset, name in enumerate(names)
        ],
        data=data.tobytes(),
    )
