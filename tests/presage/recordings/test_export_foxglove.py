"""The export for Foxglove and Lichtblick, decoded with nothing but the descriptors in the file itself."""

from __future__ import annotations

import io
import json
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import shapely
from mcap.reader import SeekingReader
from mcap_protobuf.decoder import DecoderFactory
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.messages import topics as table
from common.messages.definitions import Goal, Pose, Stamped, Truth, Twist
from common.messages.topics import BELIEF, GOAL, ODOM, TOPICS, TRUTH, Topic
from presage.recordings.export import ExportOptions, run_export
from presage.recordings.foxglove import export_foxglove
from presage.recordings.foxglove_numbers import FIELDS
from presage.recordings.foxglove_session import WallClock
from presage.recordings.foxglove_shapes import ELLIPSE_SCALE_95, ellipse, grid, world_entities
from services.recorder.reader import read_recording
from tests.presage.recordings import artificial_session as driven
from tests.recorder.sessions import WORLD


class Odour(Stamped):
    """A message that a later version may have."""

    strength: float = 0.0


LAYOUT = Path(__file__).resolve().parents[3] / "docs" / "foxglove-layout.json"
FOXGLOVE = {
    "/tf": "FrameTransforms", "/scan": "LaserScan", "/prediction": "LaserScan", "/belief": "PoseInFrame",
    "/truth": "PoseInFrame", "/odom": "PoseInFrame", "/goal": "PoseInFrame", "/hypotheses": "PosesInFrame",
    "/map": "Grid", "/world": "SceneUpdate", "/robot": "SceneUpdate", "/paths": "SceneUpdate", "/log": "Log",
    "/belief/shape": "SceneUpdate", "/goal/shape": "SceneUpdate", "/plan": "SceneUpdate",
    "/plan/obstacles": "PointCloud", "/preference": "Grid",
}  # fmt: skip


def exported(tmp_path, *leave_out, **how):
    recording = driven.write(tmp_path / "run.mcap", *leave_out, **how)
    out = tmp_path / "view.mcap"
    counts = export_foxglove(read_recording(recording), out, "", Console(quiet=True), force=False)
    return out, counts


def decoded(path):
    """Topic: (log time, message) pairs; and the channels' encodings and schemas."""
    found, kinds = defaultdict(list), {}
    with path.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            kinds[channel.topic] = (channel.message_encoding, schema.encoding, schema.name)
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                content = DecoderFactory().decoder_for("protobuf", schema)(message.data)
            found[channel.topic].append((message.log_time, content))
    return found, kinds


def ns(timestamp):
    return timestamp.seconds * 10**9 + timestamp.nanos


def xyyaw(position, rotation):
    assert (position.z, rotation.x, rotation.y) == (0, 0, 0)
    return np.array([position.x, position.y, 2 * np.arctan2(rotation.z, rotation.w)])


def chain(message):
    """Child frame: pose in map, of one FrameTransforms message."""
    links = {link.child_frame_id: link for link in message.transforms}
    poses = {"map": np.zeros(3)}
    for parent, child in (("map", "odom"), ("odom", "base_link"), ("base_link", "laser")):
        if parent in poses and child in links:
            assert links[child].parent_frame_id == parent
            poses[child] = se2.compose(poses[parent], xyyaw(links[child].translation, links[child].rotation))
    return poses


def test_schemas_of_channels(tmp_path):
    out, counts = exported(tmp_path)
    found, kinds = decoded(out)
    for topic, name in FOXGLOVE.items():
        assert kinds[topic] == ("protobuf", "protobuf", f"foxglove.{name}"), topic
    for topic in (*FIELDS, "/health/estimator"):
        assert kinds[topic][:2] == ("json", "jsonschema"), topic
    assert {topic: len(messages) for topic, messages in found.items()} == counts


def test_every_topic_is_exported(tmp_path):
    path = driven.write(tmp_path / "run.mcap")
    recording = read_recording(path)
    assert set(recording.topics().values()) == set(TOPICS)
    for form in ("foxglove", "csv", "tum"):
        run_export(
            ExportOptions(path, form, tmp_path / form), None, console := Console(record=True, file=io.StringIO())
        )
        assert "left out" not in console.export_text()


def test_unknown_topic_is_named(tmp_path, monkeypatch):
    topic = Topic("odour", Odour, "nose", 1, "newest")
    monkeypatch.setattr(table, "TOPICS", (*TOPICS, topic))
    sniffed = [(topic, topic.key("rob"), Odour(stamp_ns=n, strength=1.0).encode(), n) for n in range(3)]
    recording, console = read_recording(driven.write(tmp_path / "run.mcap", also=sniffed)), Console(record=True)
    counts = export_foxglove(recording, tmp_path / "view.mcap", "", console, force=False)
    assert counts["/scan"] == driven.STEPS
    assert re.search("left out, .*: 3 of odour", console.export_text())


def test_plans_and_preferences(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    (_, update), (_, cloud), (_, field) = found["/plan"][0], found["/plan/obstacles"][0], found["/preference"][0]
    assert [[(p.x, p.y) for p in each.points] for each in update.entities[0].lines] == [
        [(1.0, 1.0), (8.0, 1.0)], [(1.0, 1.0), (pytest.approx(1.2), 1.0)],
    ]  # fmt: skip
    assert np.frombuffer(cloud.data, "<f4").tolist() == [3.0, 1.0]
    assert (field.column_count, field.cell_size.x) == (3, 0.5)
    assert (field.pose.position.x, field.pose.position.y) == (0.5, 0.25)
    assert np.frombuffer(field.data, "<f4").reshape(-1, 3).tolist() == [[0.0, 0.5, np.inf], [0.5, 1.0, np.inf]]
    assert found["/drive"][0][1]["vx"] == 1.0


def test_growing_map(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    grown = found["/map"][-1][1]
    assert (grown.pose.position.x, grown.pose.position.y) == (1.0, 2.0)
    assert np.frombuffer(grown.data, np.uint8).reshape(-1, 5)[:, 4].tolist() == [0, 100, 255]


def test_transforms(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    corrected = [m for at, m in found["/tf"] if (at - driven.BEGAN_NS) % driven.PERIOD_NS == driven.BELIEVED_NS]
    assert len(corrected) == driven.STEPS
    scans = [scan for _, scan in found["/scan"]]
    for i, message in enumerate(corrected):
        poses, times = chain(message), {link.child_frame_id: ns(link.timestamp) for link in message.transforms}
        assert poses["base_link"] == pytest.approx(driven.believed(i), abs=1e-9)
        assert poses["laser"] == pytest.approx(se2.compose(driven.believed(i), [0.2, 0, 0]), abs=1e-9)
        moment = driven.BEGAN_NS + i * driven.PERIOD_NS  # the truth of the stamp came first
        assert times["odom"] == times["base_link"] == ns(scans[i].timestamp) == moment
        assert ns(found["/prediction"][i][1].timestamp) == ns(found["/belief"][i][1].timestamp) == moment
        assert times["laser"] == driven.BEGAN_NS  # it never moved
    assert {scan.frame_id for scan in scans} == {"laser"}


def test_scans(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    assert [at for at, _ in found["/scan"]] == [
        driven.BEGAN_NS + i * driven.PERIOD_NS + driven.SENSED_NS for i in range(driven.STEPS)
    ]
    assert {at for at, _ in [found["/map"][0], *found["/paths"]]} == {driven.BEGAN_NS}
    scan, prediction = found["/scan"][3][1], found["/prediction"][3][1]
    assert np.array(scan.ranges) == pytest.approx([1.0, np.nan, np.nan, 2.5], nan_ok=True)
    assert list(prediction.ranges) == [1.0, 1.0, 1.0, 2.5]
    assert (scan.start_angle, scan.end_angle) == pytest.approx((-0.3, 0.3))
    assert scan.pose.orientation.w == 1.0


def test_beliefs(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    (entity,) = found["/belief/shape"][5][1].entities
    best, second = entity.arrows
    assert best.color.a > second.color.a > 0
    (outline,) = entity.lines  # the second hypothesis states no covariance
    points = np.array([(p.x, p.y) for p in outline.points]) - driven.believed(5)[:2]
    assert np.abs(points).max(axis=0) == pytest.approx(ELLIPSE_SCALE_95 * np.array([0.2, 0.1]), rel=0.01)
    assert len(found["/hypotheses"][5][1].poses) == 2
    pose = found["/truth"][5][1]
    assert pose.frame_id == "map"
    assert xyyaw(pose.pose.position, pose.pose.orientation) == pytest.approx(driven.true(5))
    assert found["/odom"][5][1].frame_id == "odom"


def test_ellipse_holds_95_percent():
    covariance = np.array([[0.09, 0.05, 0.0], [0.05, 0.04, 0.0], [0.0, 0.0, 1.0]])
    outline = ellipse(np.array([1.0, 2.0, 0.0]), covariance) - [1.0, 2.0]
    distance = np.einsum("ni,ij,nj->n", outline, np.linalg.inv(covariance[:2, :2]), outline)
    assert distance == pytest.approx(np.full(len(outline), -2 * np.log(0.05)))


def test_numbers_for_plots(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    belief, error = found["/belief/numbers"][6][1], found["/error"][6][1]
    assert (belief["free_energy"], belief["accuracy"], belief["complexity"]) == (106.0, 90.0, 16.0)
    assert (belief["sigma_x"], belief["sigma_y"], belief["sigma_yaw"]) == pytest.approx((0.2, 0.1, 0.05))
    assert (belief["protection_x"], belief["protection_y"], belief["protection_yaw"]) == (0.5, 0.25, 0.125)
    assert belief["probability"] == 0.875
    assert (belief["state"], belief["hypotheses"], belief["weight"]) == ("tracking", 2, 0.75)
    assert (error["position"], error["heading"]) == pytest.approx((0.05, 0.01))
    assert error["goal_distance"] == pytest.approx(8.0 - driven.true(6)[0])
    assert "goal_distance" not in found["/error"][0][1]  # no goal yet
    assert "distance" not in found["/status"][0][1]
    health = found["/health/estimator"][1][1]
    assert health["topics"][0]["dropped"] == 2
    assert health["counters"] == [{"name": "steps", "value": 11}]
    for topic, fields in FIELDS.items():
        assert all(set(content) <= set(fields) for _, content in found[topic]), topic


def test_log_lines(tmp_path):
    found, _ = decoded(exported(tmp_path)[0])
    lines = [(line.name, line.message, line.level) for _, line in found["/log"]]
    assert lines == [
        ("estimator", "belief is ambiguous", 2),
        ("controller", "idle", 2),
        ("estimator", "no scan yet", 3),
        ("estimator", "belief is tracking", 2),
        ("goal", "goal (8, 1) m, within 0.25 m", 2),
        ("estimator", "uses version 1 of its field, learned while driving", 2),
        ("controller", "navigating: on the way", 2),
    ] + [("estimator", "the problem is over", 2)] * (len(lines) - 7)
    assert len(lines) == 8


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"cancel": True}, "the goal was cancelled"),
        ({"explore": True}, "exploring"),
        ({"explore": True, "cancel": True}, "the goal was cancelled"),
    ],
)
def test_goal_ends(tmp_path, change, text):
    request = Goal(stamp_ns=0, pose=Pose(x=0.0, y=0.0), **change).encode()
    late = driven.BEGAN_NS + driven.STEPS * driven.PERIOD_NS
    found, _ = decoded(exported(tmp_path, also=[(GOAL, GOAL.key("rob"), request, late)])[0])
    assert [line.message for _, line in found["/log"] if line.name == "goal"][1:] == [text]
    shown, gone = (message for _, message in found["/goal/shape"])
    assert [e.id for e in shown.entities] == [d.id for d in gone.deletions] == ["goal"]
    assert shown.entities[0].cylinders[0].size.x == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("missing", "driver", "where"),
    [
        ((BELIEF,), "truth", driven.true),
        ((BELIEF, TRUTH), "odom", driven.odometry),
        ((ODOM,), "belief", driven.believed),
    ],
    ids=["no belief", "odometry alone", "no odometry"],
)
def test_source_of_the_robots_pose(tmp_path, missing, driver, where):
    out, _ = exported(tmp_path, *missing)
    found, _ = decoded(out)
    last = driven.STEPS - 1
    assert chain(found["/tf"][-1][1])["base_link"] == pytest.approx(where(last), abs=1e-9)
    with out.open("rb") as stream:
        about = {m.name: m.metadata for m in SeekingReader(stream).iter_metadata()}
    assert about["export"]["base_link is driven by"] == driver
    assert about["presage"]["commit"] == "abc"  # the recording's own come along


def test_wall_clock_of_stamps():
    clock = WallClock()
    assert clock.add_sensor_message("truth", 5, 100) == 100
    assert clock.add_sensor_message("scan", 5, 103) == 100
    assert clock.time_of(5, 110) == 100
    assert clock.time_of(6, 111) == 111  # unknown stamp
    assert clock.add_sensor_message("truth", 5, 900) == 900  # the stamp came again after a restart
    assert clock.add_sensor_message("scan", 5, 902) == 900
    assert clock.time_of(5, 950) == 900


def test_error_after_a_restart(tmp_path):
    """After a reset stamps come again; the newest truth of a stamp counts."""
    late = driven.BEGAN_NS + 10**10
    truth = Truth(stamp_ns=0, pose=Pose.of(driven.believed(0)), twist=Twist()).encode()
    again = [(TRUTH, TRUTH.key("rob"), truth, late), (BELIEF, BELIEF.key("rob"), driven.belief(0).encode(), late + 5)]
    found, _ = decoded(exported(tmp_path, also=again)[0])
    assert found["/error"][0][1]["position"] == pytest.approx(0.05)
    assert found["/error"][-1][1]["position"] == pytest.approx(0.0)
    assert ns(found["/belief"][-1][1].timestamp) == late


def test_map_grid():
    message = grid(WORLD, 0)
    cell, columns = message.cell_size.x, message.column_count
    assert [field.name for field in message.fields] == ["red", "green", "blue", "alpha", "occupancy"]
    data = np.frombuffer(message.data, np.uint8).reshape(-1, columns, message.cell_stride)

    def at(x, y):
        column, row = int((x - message.pose.position.x) / cell), int((y - message.pose.position.y) / cell)
        return int(data[row, column, 4])

    assert at(5.0, 2.0) == 0
    assert [at(6.0, 4.0), at(3.0, 4.0), at(8.5, 4.2), at(5.0, 5.03), at(-0.03, 2.0)] == [100] * 5
    assert data[0, 0, 3:].tolist() == [0, 255]  # outside: clear, unknown
    free = WORLD.free_space.area
    assert np.count_nonzero(data[..., 4] == 0) * cell**2 == pytest.approx(free, rel=0.01)


def test_walls_and_furniture():
    walls, box, circle, polygon = world_entities(WORLD, 0)
    centres = np.array([(c.pose.position.x, c.pose.position.y) for c in walls.cubes])
    assert len(centres) == 4
    inside = (centres > [0, 0]).all(axis=1) & (centres < [10, 5]).all(axis=1)
    assert not inside.any()
    assert (box.cubes[0].size.x, box.cubes[0].size.y) == (1, 0.5)
    assert circle.cylinders[0].size.x == 1.0
    for slab in polygon.cubes:  # its visible faces are where the polygon is
        assert WORLD.obstacles[2].shape().covers(_point(slab.pose.position))


def _point(position):
    return shapely.Point(position.x, position.y)


def named_in(layout):
    """Topics and message paths of a layout file."""
    topics, paths = set(), set()
    for name, panel in layout["configById"].items():
        topics |= set(panel.get("topics", {}))
        topics |= {panel["topicToRender"]} if "topicToRender" in panel else set()
        paths |= {path["value"] for path in panel.get("paths", [])}
        assert re.fullmatch(r"(3D|Plot|StateTransitions|RosOut)!\w+", name)
    return topics, paths


def test_layout_names_exported_topics(tmp_path):
    layout = json.loads(LAYOUT.read_text())
    topics, paths = named_in(layout)
    found, kinds = decoded(exported(tmp_path)[0])
    assert topics <= set(found)
    assert len(topics) > 10
    for path in paths:
        topic, field = path.split(".")
        assert field in FIELDS[topic], path
        assert any(field in content for _, content in found[topic]), path
    drawable = {f"foxglove.{name}" for name in ("LaserScan", "SceneUpdate", "Grid", "PointCloud")}
    drawn = {topic for topic, kind in kinds.items() if kind[2] in drawable}
    assert drawn <= topics  # nothing that can be drawn is forgotten
    text = json.dumps(layout["layout"])
    assert all(name in text for name in layout["configById"])


def test_unfinished_recording(tmp_path):
    active = driven.write(tmp_path / "run.mcap", finish=False)
    recording, before = read_recording(active), active.read_bytes()
    for name in ("view.mcap", "run.mcap"):
        counts = export_foxglove(recording, tmp_path / name, "", Console(quiet=True), force=False)
        assert counts["/scan"] == driven.STEPS
    assert recording.warning
    assert active.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 3


def test_refusals_leave_no_file(tmp_path):
    recording = driven.write(tmp_path / "run.mcap")
    before = recording.read_bytes()
    with pytest.raises(UserError, match="--force"):
        export_foxglove(read_recording(recording), recording, "", Console(quiet=True), force=False)
    with pytest.raises(UserError, match="the recording itself"):
        export_foxglove(read_recording(recording), recording, "", Console(quiet=True), force=True)
    with pytest.raises(UserError, match="cannot be written"):
        export_foxglove(read_recording(recording), tmp_path / "no" / "x.mcap", "", Console(quiet=True), force=False)
    empty = driven.write(tmp_path / "empty.mcap", *TOPICS)
    with pytest.raises(UserError, match="nothing to export"):
        export_foxglove(read_recording(empty), tmp_path / "view.mcap", "", Console(quiet=True), force=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.mcap", "run.mcap"]
    assert recording.read_bytes() == before


def test_one_robot_of_several(tmp_path):
    other = [(t, key, m.encode(), at) for t, key, m, at in driven.events("ghost") if t == BELIEF]
    recording = read_recording(driven.write(tmp_path / "run.mcap", also=other))
    mine = export_foxglove(recording, tmp_path / "a.mcap", "", Console(quiet=True), force=False)
    ghost = export_foxglove(recording, tmp_path / "b.mcap", "ghost", Console(quiet=True), force=False)
    assert (mine["/belief"], mine["/scan"]) == (driven.STEPS, driven.STEPS)
    assert ghost["/belief"] == driven.STEPS
    assert "/scan" not in ghost
    with pytest.raises(UserError, match="no robot 'x' in it; it has ghost, rob"):
        export_foxglove(recording, tmp_path / "c.mcap", "x", Console(quiet=True), force=False)
