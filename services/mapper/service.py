"""The mapper service: scans in; the map so far and the robot's pose in it out."""

from __future__ import annotations

import re
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar

import numpy as np

from common.errors import UserError
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.ros_map_writer import write_grid
from common.geometry.se2 import Array
from common.geometry.tum import write_tum
from common.geometry.world import known_worlds
from common.messages.definitions import MAX_LATE_NS, Belief, BeliefHypothesis, Map, Odom, Pose, Scan, Stamped
from common.messages.requests import FILE_NAME, Reply, Request, SaveMapReply, SaveMapRequest
from common.messages.topics import BELIEF, MAP, ODOM, SAVE_MAP, SCAN, Query, Topic
from common.robot.motion_distortion import evenly_spaced
from common.robot.ranges import ranges_for_localisation
from common.robot.scan_geometry import Sweep
from common.runtime.odometry_sync import OdometrySync
from common.runtime.service import Service
from common.writing import complete_files
from services.mapper.settings import MapperSettings
from services.mapper.slam.correlative_search import correlative_search
from services.mapper.slam.drive import Laser
from services.mapper.slam.elements import elements_of_scan
from services.mapper.slam.front_end import ScanPose
from services.mapper.slam.mapper import Mapper, MapSnapshot

MAX_GAP_NS = 10_000_000_000  # longest time between two scans of which the second one follows the first
MAX_BEAM_RATIO = 1.1  # of a scan to the first one; numbers of beams that vary from turn to turn differ by less
UPDATE_PERIOD_NS = 1_000_000_000  # least time between the starts of two updates of the map
REPEAT_PERIOD_NS = 5_000_000_000  # an unchanged map is published again after this time, for later subscribers


class MapperService(Service):
    """Publishes a belief for each scan, and the map whenever it has grown.

    Loop closing and drawing the map take seconds in a large building, so they run in a second thread, one update at a
    time. Scans for which there is no time meanwhile are dropped, and counted in the health message.
    """

    name: ClassVar[str] = "mapper"
    single: ClassVar[bool] = True
    inputs: ClassVar[tuple[Topic, ...]] = (SCAN, ODOM)
    queries: ClassVar[tuple[Query, ...]] = (SAVE_MAP,)

    settings: MapperSettings

    def __init__(self, settings: MapperSettings) -> None:
        super().__init__(settings)
        self.mapper: Mapper | None = None
        self._belief: Belief | None = None  # of the latest scan
        self._received_ns = 0  # stamp of the latest scan, also if it was left out
        self._odometry_sync = OdometrySync()
        self._pool = ThreadPoolExecutor(1, "update")
        self._update: Future[MapSnapshot] | None = None  # running
        self._update_ns = self._published_ns = 0  # stamps of the last update and of the last map

    def open(self) -> None:
        """Compiles the search now, so that no scan has to wait for it."""
        wall = elements_of_scan(np.full(9, 2.0), np.linspace(-0.1, 0.1, 9), np.zeros(3), 10.0)
        correlative_search(wall, wall, np.zeros(3), np.full(3, 0.1))

    def close(self) -> None:
        """Waits for the running update."""
        self._pool.shutdown(cancel_futures=True)

    def on_message(self, topic: Topic, message: Stamped) -> None:  # noqa: ARG002
        """Maps a scan together with its odometry, if there is any."""
        if isinstance(message, Odom):
            ready = self._odometry_sync.add_odometry(message)
        elif isinstance(message, Scan):
            ready = self._odometry_sync.add_scan(message)
        else:
            return
        for scan, odom in ready:
            self._add(scan, odom)

    def _add(self, scan: Scan, odom: Odom | None) -> None:
        received_before_ns, self._received_ns = self._received_ns, scan.stamp_ns
        if self._belief is not None:
            late_ns = self._belief.stamp_ns - scan.stamp_ns
            if late_ns == 0:
                self.publish(BELIEF, self._belief)  # a repeated scan gets the same belief again
                return
            # A single scan whose stamp is far from all others is late or has a wrong stamp, and is left out. If another
            # scan follows it, the clock was set, as by a reset of the simulator, and mapping goes on.
            last_stamps_ns = self._belief.stamp_ns, received_before_ns
            follows_another = any(0 <= scan.stamp_ns - each <= MAX_GAP_NS for each in last_stamps_ns)
            if 0 < late_ns < MAX_LATE_NS or not follows_another:
                self.counters["scans_out_of_order"] += 1
                return
        mapper, angles = self._mapper_for(scan), scan.angles()
        ranges = ranges_for_localisation(scan.ranges)
        if not np.array_equal(angles, mapper.laser.angles):  # some scanners' numbers of beams vary from turn to turn
            ranges = evenly_spaced(ranges, angles, Sweep.of_angles(mapper.laser.angles), -np.inf)
        scan_pose = mapper.add(scan.stamp_ns * 1e-9, ranges, None if odom is None else odom.pose.array())
        if not scan_pose.matched:
            self.counters["unmatched_scans"] += 1
        self._belief = belief_message(scan, scan_pose)
        self.publish(BELIEF, self._belief)
        # After a reset, the scan may be earlier than both stamps.
        if self._update is None and mapper.outdated and abs(scan.stamp_ns - self._update_ns) >= UPDATE_PERIOD_NS:
            self._start_update(mapper, scan.stamp_ns)
        if abs(scan.stamp_ns - self._published_ns) >= REPEAT_PERIOD_NS:
            self._publish_map(mapper)

    def _start_update(self, mapper: Mapper, stamp_ns: int) -> None:
        self._update_ns = stamp_ns
        self._update = self._pool.submit(mapper.update, mapper.key_scans())
        self._update.add_done_callback(lambda _: self.loop.inbox.wake())

    def _mapper_for(self, scan: Scan) -> Mapper:
        """The mapper; a new one if the scan does not fit its laser."""
        if self.mapper is not None:
            reason = _reason_to_start_again(self.mapper, scan)
            if not reason:
                return self.mapper
            self.log.warning("mapping starts again", reason=reason)
            self._update = None  # its result belongs to the old map
        laser = Laser(scan.angles(), scan.mount.array(), scan.range_max, scan.time_increment)
        self.mapper = Mapper(laser, self.settings.cell)
        self._update_ns = self._published_ns = scan.stamp_ns - UPDATE_PERIOD_NS
        return self.mapper

    def due(self) -> float | None:
        """Returns 0 if an update is done."""
        return 0.0 if self._update is not None and self._update.done() else None

    def on_timer(self) -> None:
        """Replaces the map by the updated one, and publishes it."""
        update, self._update = self._update, None
        assert self.mapper is not None and update is not None  # noqa: S101, PT018 - see `due`; only a mapper starts updates
        try:
            self.mapper.use(update.result())
            self.note = ""
        except UserError as error:
            self.note = str(error)
        self._publish_map(self.mapper)

    def _publish_map(self, mapper: Mapper) -> None:
        if mapper.map is not None and self._belief is not None:
            self._published_ns = self._belief.stamp_ns
            self.publish(MAP, map_message(self._belief.stamp_ns, mapper.map))

    def on_request(self, query: Query, request: Request) -> Reply | Future[Reply]:
        """Saves the map of the scans until now, in the second thread."""
        if not isinstance(request, SaveMapRequest):
            return super().on_request(query, request)
        if self.mapper is None:
            raise UserError("there is no map yet: no scan has come")
        return self._pool.submit(self._save, saving(self.settings.maps, request.name, self.mapper))

    def _save(self, save: Callable[[], Path]) -> Reply:
        path = save()
        self.log.info("map saved", file=str(path))
        return SaveMapReply(file=str(path))


def _reason_to_start_again(mapper: Mapper, scan: Scan) -> str:
    """Returns why mapping has to start again for a scan, or an empty text if the mapper can use it."""
    if not np.allclose(scan.mount.array(), mapper.laser.mount, atol=1e-4):
        return "the scanner's mount changed"
    if mapper.key_scan_count == 1 and len(scan.ranges) > MAX_BEAM_RATIO * len(mapper.laser.angles):
        return "the first scan lacked some of the beams"
    return ""


def saving(folder: Path, name: str, mapper: Mapper) -> Callable[[], Path]:
    """Returns a function that writes map and trajectory of the scans until now, and returns the path of NAME.yaml.

    Another thread may call it, because drawing takes seconds. Both raise UserError if they fail.
    """
    if mapper.map is None:
        raise UserError("there is no map yet: try again in some seconds; if that does not help, scans show too little")
    if re.fullmatch(FILE_NAME, name) is None or name in known_worlds():
        raise UserError(f"name {name!r}: give up to 64 letters, digits, - and _, and not the name of a shipped world")
    drawing, trajectory, path = mapper.drawing(), mapper.trajectory(), folder.resolve() / f"{name}.yaml"

    def save() -> Path:
        _write_map(path, drawing(), trajectory)
        return path

    return save


def _write_map(path: Path, grid: OccupancyGrid, trajectory: tuple[Array, Array]) -> None:
    files = [path.with_suffix(suffix) for suffix in (".yaml", ".pgm", ".tum")]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if existing := next((file for file in files if file.exists()), None):
            raise UserError(f"{existing} exists already: choose another name")
        with complete_files(path) as partial:
            write_grid(partial, path.stem, grid)
            write_tum(partial / f"{path.stem}.tum", *trajectory)
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({error.strerror}): free space, or start the mapper with another folder "
            "(PRESAGE_MAPPER_MAPS)"
        ) from None


def belief_message(scan: Scan, scan_pose: ScanPose) -> Belief:
    """The belief that states the pose of a scan."""
    pose, covariance = Pose.of(scan_pose.pose), scan_pose.covariance if scan_pose.matched else None
    return Belief(
        stamp_ns=scan.stamp_ns,
        state="tracking" if scan_pose.matched else "lost",
        pose=pose,
        covariance=covariance,
        hypotheses=[BeliefHypothesis(pose=pose, covariance=covariance, weight=1.0)],
        estimator="mapper",
    )


def map_message(stamp_ns: int, snapshot: MapSnapshot) -> Map:
    """The map as a message."""
    ends = snapshot.poses[snapshot.closures.ravel(), :2].astype(np.float32)
    known = np.isfinite(snapshot.poses).all(axis=1)
    return Map(
        stamp_ns=stamp_ns,
        grid=snapshot.grid,
        poses=snapshot.poses[known],
        closures=ends,
        connected=np.asarray(known, np.uint8),
    )
