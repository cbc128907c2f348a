"""The mapper as a process, over real zenoh."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from rich.console import Console

from common.bus.inbox import Inbox
from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import OccupancyGrid
from common.geometry.world import load_world
from common.messages.definitions import Belief, Map, Odom, Pose, Scan, Twist
from common.messages.requests import SaveMapReply, SaveMapRequest
from common.messages.topics import BELIEF, MAP, ODOM, SAVE_MAP, SCAN
from common.robot.scan_geometry import Sweep
from lab.accuracy import tasks
from lab.accuracy.scenes import Scene
from presage.live.commands import save_map
from services.mapper import service
from services.mapper.service import MapperService, map_message
from services.mapper.settings import MapperSettings
from services.mapper.slam.mapper import MapSnapshot
from tests.conftest import WAIT_TIMEOUT_S, wait_for_message
from tests.mapper.drives import driven

OFFICE = load_world("office")


def scan_message(drive, k, ranges=None):
    first, increment, _ = Sweep.of_angles(drive.laser.angles)
    return Scan(
        stamp_ns=round(drive.stamps[k] * 1e9),
        angle_min=first,
        angle_increment=increment,
        range_min=0.05,
        range_max=drive.laser.range_max,
        ranges=drive.ranges[k] if ranges is None else ranges,
        mount=Pose.of(drive.laser.mount),
    )


@pytest.mark.parametrize("odometry", [True, False])
def test_drive_and_save(process, bus, link, tmp_path, odometry):
    truth = Scene.of(OFFICE, 300, 5).path(8)
    drive, inbox, maps = driven(OFFICE, truth), Inbox(), Inbox()
    bus.subscribe(BELIEF, inbox)
    bus.subscribe(MAP, maps)
    process("mapper", "--maps", str(tmp_path / "maps"))
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    assert bus.wait_matching(ODOM, WAIT_TIMEOUT_S)

    def belief_of(scan, pose):
        if odometry:
            odom = Odom(stamp_ns=scan.stamp_ns, pose=Pose.of(pose), twist=Twist(), covariance=np.eye(3))
            bus.put(ODOM, odom.encode())
        bus.put(SCAN, scan.encode())
        return wait_for_message(inbox, Belief, lambda b: b.stamp_ns == scan.stamp_ns)

    beliefs = [belief_of(scan_message(drive, k), pose) for k, pose in enumerate(truth)]
    assert {belief.state for belief in beliefs} == {"tracking"}
    poses = np.array([belief.pose.array() for belief in beliefs])
    error = se2.compose(truth[0], poses)[:, :2] - truth[:, :2]
    assert np.hypot(*error.T).max() < 0.05
    grown = wait_for_message(maps, Map, lambda message: len(message.poses) > 3)
    assert np.abs(grown.poses[0]).max() < 0.01

    save_map(link, "here", Console(quiet=True))
    world = load_world(str(tmp_path / "maps" / "here.yaml"))
    assert (world.clearance(poses[:, :2]) > 0).mean() > 0.9
    assert np.loadtxt(tmp_path / "maps" / "here.tum").shape == (len(truth), 8)
    for name, reason in (("here", "exists already"), ("../here", "letters"), ("office", "shipped")):
        reply = bus.query(SAVE_MAP, SaveMapRequest(name=name), SaveMapReply)
        assert not reply.ok
        assert reason in reply.reason

    last = len(truth) - 1
    nonsense = np.random.default_rng(0).uniform(1, 8, drive.ranges.shape[1])
    lost = scan_message(drive, last, nonsense).model_copy(update={"stamp_ns": round(drive.stamps[last] * 1e9) + 10**8})
    belief = belief_of(lost, truth[last])
    assert belief.state == "lost"
    assert belief.covariance is None

    # A late scan is left out, and leaves the map.
    bus.put(SCAN, scan_message(drive, last - 1).model_copy(update={"stamp_ns": lost.stamp_ns - 10**7}).encode())
    later = scan_message(drive, last).model_copy(update={"stamp_ns": lost.stamp_ns + 10**8})
    found = belief_of(later, truth[last])
    assert tasks.is_at(se2.compose(truth[0], found.pose.array()), truth[last])


@pytest.fixture
def mapper(monkeypatch):
    """A mapper service without a bus; `drive(scans)` returns the beliefs that it publishes."""
    mapping, published = MapperService(MapperSettings()), []
    monkeypatch.setattr(mapping, "_loop", Mock(publish=lambda _, message: published.append(message)))

    def drive(scans):
        published.clear()
        for scan in scans:
            mapping.on_message(SCAN, scan)
            while mapping.due() == 0:
                mapping.on_timer()
        return [message for message in published if isinstance(message, Belief)]

    mapping.drive = drive
    yield mapping
    mapping.close()


def is_close(belief, truth, start):
    return tasks.is_at(se2.compose(start, belief.pose.array()), truth)


def stamped(scan, stamp_s):
    return scan.model_copy(update={"stamp_ns": round(stamp_s * 1e9)})


@pytest.mark.parametrize("step_s", [-5.0, 1000.0])
def test_a_scan_with_another_stamp_leaves_the_map(mapper, step_s):
    truth = Scene.of(OFFICE, 300, 5).path(6)
    drive = driven(OFFICE, truth)
    scans = [scan_message(drive, k) for k in range(len(truth))]
    scans[70] = stamped(scans[0], 70 / 15 + step_s)
    beliefs = mapper.drive(scans)
    assert len(beliefs) == len(scans) - 1
    assert {belief.state for belief in beliefs} == {"tracking"}
    assert is_close(beliefs[-1], truth[-1], truth[0])


@pytest.mark.parametrize("moved", [0, 69])
def test_reset_keeps_the_map(mapper, moved):
    """After a reset of the simulator, the robot is back at its start. A clock may also be set while it stands."""
    truth = Scene.of(OFFICE, 300, 5).path(6)
    drive = driven(OFFICE, truth)
    scans = [scan_message(drive, k) for k in range(70)]
    mapper.drive(scans)
    before = mapper.mapper
    count = len(before.key_scans().poses)
    beliefs = mapper.drive([stamped(scans[moved], k / 15) for k in range(15)])
    assert mapper.mapper is before
    assert len(before.key_scans().poses) >= count
    assert all(is_close(each, truth[moved], truth[0]) for each in beliefs if each.state == "tracking")
    if moved == 69:
        assert {each.state for each in beliefs} == {"tracking"}


def test_first_scan_with_few_beams(mapper):
    """The map is drawn with the beams of later scans; numbers of beams that vary a little do not matter."""
    truth = Scene.of(OFFICE, 300, 5).path(3)
    drive = driven(OFFICE, truth)
    full = [scan_message(drive, k) for k in range(len(truth))]
    first = full[0].model_copy(
        update={"ranges": full[0].ranges[120:180], "angle_min": full[0].angle_min + 120 * full[0].angle_increment}
    )
    varying = [scan.model_copy(update={"ranges": scan.ranges[: 300 - k % 3]}) for k, scan in enumerate(full[1:], 1)]
    beliefs = mapper.drive([first, *varying])
    assert len(mapper.mapper.laser.angles) == 299
    assert {belief.state for belief in beliefs} == {"tracking"}
    assert is_close(beliefs[-1], truth[-1], truth[1])


def test_key_scans_keep_their_numbers():
    grid = OccupancyGrid.of(np.zeros((2, 2), np.uint8), 0.05, (0.0, 0.0, 0.0))
    poses = np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [np.nan] * 3, [1.0, 0.0, 0.0]])
    message = map_message(7, MapSnapshot(grid, poses, np.array([[0, 3]])))
    assert message.numbers.tolist() == [0, 3]
    assert message.poses.tolist() == poses[[0, 3]].tolist()


def test_save_before_the_first_scan(process, bus):
    process("mapper")
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    reply = bus.query(SAVE_MAP, SaveMapRequest(name="here"), SaveMapReply)
    assert "no scan has come" in reply.reason


def test_a_failed_save_leaves_the_name_free(tmp_path, monkeypatch):
    grid = OccupancyGrid.of(np.zeros((2, 2), np.uint8), 0.05, (0.0, 0.0, 0.0))
    mapper = SimpleNamespace(
        map=MapSnapshot(grid, np.zeros((1, 3)), np.zeros((0, 2), np.intp)),
        drawing=lambda: lambda: grid,
        trajectory=lambda: (np.zeros(1), np.zeros((1, 3))),
    )
    monkeypatch.setattr(service, "write_tum", Mock(side_effect=OSError(28, "No space left on device")))
    with pytest.raises(UserError, match=r"here\.yaml: cannot be written \(No space left on device\)"):
        service.saving(tmp_path, "here", mapper)()
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    assert service.saving(tmp_path, "here", mapper)() == tmp_path / "here.yaml"
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(UserError, match="with another folder"):
        service.saving(tmp_path / "file", "here", mapper)()
