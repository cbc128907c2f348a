"""`presage map`: where beams of known poses ended is occupied, where they went through is free."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from common.geometry.ros_map_writer import write_grid
from common.geometry.world import load_world
from lab.accuracy.motion_distortion import observations
from lab.accuracy.scenes import Scene
from presage.learning.map_of_log import MapOptions, _build_trajectory, map_command
from presage.learning.train_drive import drive_of
from presage.logs.log import Reading
from presage.logs.scan_files import Scans, read_scans
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.surfaces import Beams, SurfaceCells
from services.estimator.shared.generative_models import RayCaster
from services.estimator.shared.interface import Observation
from services.mapper.slam.drive import Laser
from services.mapper.slam.grid import grid_of_scans
from tests.lab.real_logs import drives as real_drive
from tests.recorder import sessions as recorded

QUIET = Console(quiet=True)
HERE = Reading(mount=np.zeros(3))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "drive.npz"
    real_drive.save(path, real_drive.drive(200))
    return path


def made(log, tmp_path, half=""):
    return load_world(
        str(map_command(MapOptions(log, tmp_path / "made.yaml", half, reading=HERE, poses="reference"), QUIET, QUIET))
    )


@pytest.mark.parametrize(("half", "world"), [("first", real_drive.BEFORE), ("second", real_drive.AFTER)])
def test_map_of_a_half(log, tmp_path, half, world):
    mapped = made(log, tmp_path, half)
    other = real_drive.AFTER if world is real_drive.BEFORE else real_drive.BEFORE
    x, y = np.meshgrid(np.arange(0.5, 8.9, 0.1), np.arange(0.5, 5.9, 0.1))
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    values, room, away = mapped.grid.values_at(places), world.clearance(places), other.clearance(places)
    looked = values != UNKNOWN
    assert (values[looked & (room > 0.15)] == FREE).mean() > 0.99
    assert looked[room > 0.15].mean() > 0.9
    # Where the box was at the other time, nothing is in the way.
    assert (values[(away < -0.05) & (room > 0.15)] == FREE).mean() > 0.9
    rays, seen = (
        RayCaster(each).expect(np.array([[3.0, 3.0, 0.0]]), real_drive.ANGLES).ranges for each in (world, mapped)
    )
    assert np.median(np.abs(seen - rays)) < 0.06
    assert abs(np.median(seen - rays)) < 0.025  # half a cell


def test_half_with_too_few_scans_for_a_model(tmp_path):
    log, map_file = tmp_path / "drive.npz", tmp_path / "made.yaml"
    real_drive.save(log, real_drive.drive(60))
    options = MapOptions(log, map_file, "first", reading=HERE, poses="reference", models=tmp_path)
    with pytest.raises(UserError, match="30 scans to learn from; a model needs at least 50: add --no-learn"):
        map_command(options, QUIET, QUIET)
    assert not map_file.exists()  # so that the command can be given again


def test_who_walks_through_is_not_in_the_map():
    count, angles = 20, np.deg2rad(np.arange(-90, 91.0))
    ranges = np.full((count, len(angles)), 4.0)
    for k in range(count):
        ranges[k, 8 * k : 8 * k + 8] = 2.0
    grid = grid_of_scans(np.zeros((count, 3)), ranges, Laser(angles, np.zeros(3), 30.0), 0.05)

    def at(radius):
        return grid.values_at(radius * np.column_stack([np.cos(angles), np.sin(angles)]))

    assert (at(4.0) == OCCUPIED).mean() > 0.95
    assert (at(2.0) == FREE).all()
    assert (at(4.3) == UNKNOWN).all()


def test_what_cannot_be_is_said(log, tmp_path):
    with pytest.raises(UserError, match="no half 'third'"):
        map_command(MapOptions(log, tmp_path / "a.yaml", "third", reading=HERE, poses="reference"), QUIET, QUIET)
    with pytest.raises(UserError, match=r"give NAME\.yaml"):
        map_command(MapOptions(log, tmp_path / "a.png", reading=HERE, poses="reference"), QUIET, QUIET)
    with pytest.raises(UserError, match="no poses 'none'"):
        map_command(MapOptions(log, tmp_path / "a.yaml", poses="none"), QUIET, QUIET)
    (tmp_path / "a.pgm").write_bytes(b"mine")
    (tmp_path / "a.png").write_bytes(b"mine")
    with pytest.raises(UserError, match=r"exists already: .*a\.pgm, .*a\.png;"):
        map_command(MapOptions(log, tmp_path / "a.yaml", reading=HERE, poses="reference"), QUIET, QUIET)
    bare = tmp_path / "bare.npz"
    real_drive.save(bare, real_drive.drive(20), reference=False)
    with pytest.raises(UserError, match="no reference poses"):
        map_command(MapOptions(bare, tmp_path / "b.yaml", reading=HERE, poses="reference"), QUIET, QUIET)
    drive = real_drive.drive(20)
    with pytest.raises(UserError, match="larger --cell"):
        grid_of_scans(drive.poses, drive.ranges, Laser(drive.angles, drive.mount, drive.range_max), 0.0005)
    assert not list(tmp_path.glob("*.yaml"))


def test_ranges_in_another_unit(tmp_path):
    path, drive = tmp_path / "far.npz", real_drive.drive(20)
    real_drive.save(path, replace(drive, ranges=1000 * drive.ranges, range_max=1000 * drive.range_max))
    with pytest.raises(UserError, match=r"no scanner measures more than 1000 m: are the ranges in mm\?"):
        map_command(MapOptions(path, tmp_path / "f.yaml", reading=HERE), QUIET, QUIET)
    assert not (tmp_path / "f.yaml").exists()


def test_surfaces_too_far_apart():
    beams = Beams(np.zeros((2, 2)), np.array([0.0, 1.6]), np.array([900.0, 900.0]))
    with pytest.raises(UserError, match=r"is too large for.* `range_max` \(section `log` of"):
        SurfaceCells.of(beams, 0.05)
    with pytest.raises(UserError, match="no two beams end near each other"):
        Beams(np.zeros((0, 2)), np.zeros(0), np.zeros(0)).check_any()


def test_folder_of_the_model_is_checked_first(log, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "a-room-precise.safetensors").touch()
    for models, message in (("file", "choose another folder with --models"), ("models", "exists already")):
        with pytest.raises(UserError, match=message):
            map_command(MapOptions(log, tmp_path / "a room.yaml", models=tmp_path / models), QUIET, QUIET)
    with pytest.raises(UserError, match="no such file"):
        map_command(
            MapOptions(tmp_path / "no.npz", tmp_path / "new" / "maps" / "a.yaml", models=tmp_path / "new"), QUIET, QUIET
        )
    assert not (tmp_path / "new").exists()


def test_mount_of_a_recording(tmp_path):
    recorded.write(tmp_path / "run.mcap")
    with pytest.raises(UserError, match="contains the description of its scanner"):
        map_command(
            MapOptions(tmp_path / "run.mcap", tmp_path / "r.yaml", reading=HERE, poses="reference"), QUIET, QUIET
        )


def test_a_map_needs_no_stamps(log, tmp_path):
    with np.load(log) as arrays:
        np.savez(tmp_path / "bare.npz", **{name: values for name, values in arrays.items() if name != "stamps"})
    options = MapOptions(tmp_path / "bare.npz", tmp_path / "bare.yaml", reading=HERE, poses="reference")
    notes = Console(file=io.StringIO())
    bare = map_command(options, QUIET, notes)
    assert "the scans have no stamps: they are taken to be 1 s apart, also in" in notes.file.getvalue()
    assert load_world(str(bare)).grid.values.tolist() == made(log, tmp_path).grid.values.tolist()


def test_a_log_without_returns_is_refused(tmp_path):
    path, drive = tmp_path / "empty.npz", real_drive.drive(20)
    real_drive.save(path, replace(drive, ranges=np.full_like(drive.ranges, np.inf)))
    with pytest.raises(UserError, match="no beam of the scans"):
        map_command(MapOptions(path, tmp_path / "e.yaml", reading=HERE, poses="reference"), QUIET, QUIET)


@pytest.mark.parametrize("odometry", [True, False])
def test_map_without_reference_poses(log, tmp_path, odometry):
    options = MapOptions(log, tmp_path / "own.yaml", reading=HERE, odometry=odometry)
    world = load_world(str(map_command(options, QUIET, QUIET)))
    width, height = np.ptp(np.argwhere(world.grid.values == OCCUPIED), axis=0) * 0.05
    assert sorted((width, height)) == pytest.approx([6, 9], abs=1.0)
    assert len(np.loadtxt(tmp_path / "own.tum")) == 200
    assert (tmp_path / "own.png").exists()


def test_odometry_that_begins_after_the_first_scan(log, tmp_path):
    """As in many ROS bags. The other scans are mapped with odometry."""
    scans = read_scans(log, reading=HERE)
    scans.odom[:2] = np.nan
    console = Console(record=True, width=500, file=io.StringIO())
    built = _build_trajectory(scans, scans.stamps, MapOptions(log, tmp_path / "own.yaml"), console, QUIET)
    assert "with odometry for 198 of 200 scans" in console.export_text()
    assert np.isfinite(built.poses).all()


def test_wrong_scale_of_odometry(log, tmp_path):
    scans = read_scans(log, reading=HERE)
    scans.odom[:, :2] *= 1.3
    console = Console(record=True, width=500, file=io.StringIO())
    _build_trajectory(scans, scans.stamps, MapOptions(log, tmp_path / "own.yaml"), QUIET, console)
    assert re.search(r"warning: the odometry reports 1\.(29|3\d) times the distances", console.export_text())


def test_few_scans_per_second_without_odometry(log, tmp_path):
    """The robot may have turned by any angle between two scans, and the room looks alike from two sides."""
    scans = read_scans(log, reading=HERE).part(np.arange(0, 200, 15))
    console = Console(record=True, width=500, file=io.StringIO())
    options = MapOptions(log, tmp_path / "own.yaml", odometry=False)
    built = _build_trajectory(scans, scans.stamps, options, console, QUIET)
    placed = np.isfinite(built.poses).all(axis=1)
    assert "moved too far between two scans (0.267 per second, without odometry)" in console.export_text()
    assert 0 < placed.mean() < 0.5
    error = se2.between(scans.truth, se2.compose(scans.truth[0], built.poses))[placed]
    assert np.abs(error).max() < 0.1


def test_swept_scans():
    """The ranges that are drawn are nearer to those of instantaneous scans."""
    scene = Scene.of(load_world("office"), 300, 5)
    path = scene.path(5, at_full_speed=True)
    observed = observations(scene, path, "corrected", "laser only")
    ranges, stamps = np.array([each.ranges for each in observed]), np.arange(len(observed)) / scene.scanner.rate
    geometry, increment = ScannerGeometry.of(scene.scanner), observed[0].time_increment
    swept = Scans(geometry, ranges, stamps, truth=path[:-1], time_increment=increment)
    errors = []
    for each in (swept, replace(swept, time_increment=0.0)):
        off = np.abs(drive_of(each, Path("drive.bag")).ranges - scene.clean(path[:-1]))
        errors.append(np.quantile(off[np.isfinite(off)], 0.9))
    assert errors[0] < 0.5 * errors[1]


def test_refined_map_keeps_the_rough_frame(tmp_path):
    log, truth = tmp_path / "drive.npz", real_drive.drive(140)
    real_drive.save(log, truth)
    turned = se2.compose([3.0, -1.0, 0.7], truth.poses)  # the frame of the rough map
    rough = grid_of_scans(turned, truth.ranges, Laser(truth.angles, truth.mount, truth.range_max), 0.05)
    file = write_grid(tmp_path, "rough", rough)
    options = MapOptions(log, tmp_path / "fine.yaml", reading=HERE, refine=str(file), models=tmp_path)
    map_command(options, QUIET, QUIET)
    placed = np.loadtxt(tmp_path / "fine.tum")[:, 1:3]
    assert (placed - turned[:, :2]).mean(axis=0) == pytest.approx(0, abs=0.01)
    fine = EstimatorOptions(str(tmp_path / "fine.yaml"), models=tmp_path)
    estimator = prepare_factory(fine)(ScannerGeometry(truth.angles, truth.mount, truth.range_max))
    estimator.restart(turned[0])
    posterior = estimator.update(Observation(truth.ranges[0], truth.angles, truth.range_max, 0.0))
    assert posterior.pose[:2] == pytest.approx(turned[0, :2], abs=0.05)


def test_damaged_model_of_the_rough_map(log, tmp_path):
    file = weights.path_of(tmp_path, made(log, tmp_path).name)
    file.write_bytes(b"no weights")
    options = MapOptions(log, tmp_path / "fine.yaml", reading=HERE, refine=str(tmp_path / "made.yaml"), models=tmp_path)
    with pytest.raises(UserError, match=file.name):
        map_command(options, QUIET, QUIET)
