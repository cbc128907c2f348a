"""`presage train --from` and `presage experiment real` on a small artificial drive."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from common.errors import UserError
from common.geometry import se2
from common.geometry.world import World, load_world, save_world
from lab.real_logs import experiment as real
from lab.real_logs import filter_tuning as real_tuning
from lab.real_logs.drive import (
    ESTIMATORS,
    KIDNAPPED,
    LASER,
    MAX_SEARCH_SCANS,
    ODOMETRY,
    StretchJob,
    create_estimator,
    drive_at,
    hide_kidnapping,
)
from lab.real_logs.drive import trial as one_trial
from lab.real_logs.filter_tuning import starting_point
from presage.learning.train_drive import TrainDriveOptions as Training
from presage.learning.train_drive import split, train_from_drive
from presage.logs.log import Reading
from services.estimator.particle_filter import ParticleFilterSettings
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.field_learning import Recipe
from services.estimator.precise.motion_model import MotionNoise
from tests.lab.real_logs import drives as real_drive

HERE = Reading(mount=np.zeros(3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the log, the map of its first half, and the weights trained on that half."""
    made = tmp_path_factory.mktemp("drive")
    real_drive.save(made / "drive.npz", real_drive.drive(200))
    (made / "before.yaml").write_text(save_world(real_drive.BEFORE), encoding="utf-8")
    recipe = Recipe(resolution=0.05, sweeps=4, beams_per_sweep=40_000)
    job = Training(made / "drive.npz", str(made / "before.yaml"), made, 100, recipe, 0.5, HERE)
    train_from_drive(job, Console(quiet=True))
    return made


def test_card(folder):
    _, seeds, card = weights.load(folder / "before-precise.safetensors")
    assert card.source == "100 posed scans of drive.npz; elsewhere 100 simulated scans in map before"
    assert card.calibration is not None
    assert card.calibration.scans == 20
    assert card.test_range_error_median_m < 0.03
    assert len(seeds.places) > 50
    assert (folder / "before-precise.png").stat().st_size > 10_000
    raw = json.loads((folder / "before-precise.json").read_text(encoding="utf-8"))
    assert raw["calibration"]["log_likelihood"] == pytest.approx(card.calibration.log_likelihood)
    older = raw | {"calibration": raw["calibration"] | {"late": 0.1, "dependence": 9.0, "spread": 30.0}}
    assert weights.FieldCard.model_validate(older).calibration == card.calibration


def test_too_few_reference_poses(tmp_path):
    real_drive.save(tmp_path / "bare.npz", real_drive.drive(60), reference=False)
    with pytest.raises(UserError, match="no reference poses"):
        train_from_drive(Training(tmp_path / "bare.npz", out=tmp_path, reading=HERE), Console(quiet=True))
    real_drive.save(tmp_path / "short.npz", real_drive.drive(60))
    with pytest.raises(UserError, match="30 scans with a reference pose; training needs at least 50"):
        train_from_drive(Training(tmp_path / "short.npz", out=tmp_path, share=0.5, reading=HERE), Console(quiet=True))


@pytest.mark.parametrize("estimator", [name for name in ESTIMATORS if name != "amcl-defaults"])
def test_kidnapped_robot(folder, estimator):
    job = StretchJob(
        str(folder / "drive.npz"), str(folder / "before.yaml"), (0.0, 0.0, 0.0), estimator, KIDNAPPED, 100, to=155,
        model=str(folder / "before-precise.safetensors"),
        particles=(
            *starting_point(MotionNoise()), ("keep_initial_pose", 0.0), ("max_particles", 4000), ("min_particles", 500),
        ),
    )  # fmt: skip
    row = one_trial(job)
    assert len(row["error_m"]) == 10 + min(MAX_SEARCH_SCANS, 45)
    assert np.median(row["error_m"][:10]) < 0.2
    found = real.summarise([row])
    assert found["found"] == 1
    if estimator == "precise":  # only three surfaces change: until it has moved on, the belief is ambiguous
        assert found["wrong"] == 0
        assert found["tracking"] > 0


def test_scans_used_for_tuning(folder, tmp_path, monkeypatch):
    """The half evaluated later must not affect the settings, and the map must lack rooms, as it does later."""
    tried = []

    def fake(job):
        tried.append(job)
        error = [0.1 if dict(job.particles).get("keep_initial_pose", 1.0) else 9.0] * 20
        return {"task": job.task, "error_m": error, "yaw_error_rad": [0.0] * 20, "state": ["tracking"] * 20}

    monkeypatch.setattr(real_tuning, "trial", fake)
    job = StretchJob(
        str(folder / "drive.npz"), str(folder / "before.yaml"), (0.0, 0.0, 0.0), "particle-filter", LASER, 0
    )
    tuned = real_tuning.tune(job, 100, starting_point(MotionNoise()), tmp_path, lambda *_: None)
    for each in (tuned.odometry, tuned.laser):
        assert dict(each).get("keep_initial_pose", 1.0) == 1.0  # recovery was tried and rejected
    assert dict(tuned.finding)["keep_initial_pose"] == 0.0
    assert any(dict(each.particles).get("keep_initial_pose") == 0.0 for each in tried if each.task == LASER)
    for each in tried:
        assert each.first >= 50
        assert max(each.first + each.count, each.to + MAX_SEARCH_SCANS * (each.task == KIDNAPPED)) <= 100
    mapped = load_world(tried[0].map)
    poses = job.drive.poses[:50, :2]
    assert mapped.grid is not None
    assert (mapped.clearance(poses) > 0).mean() > 0.9


def test_motion_model_of_amcl(folder):
    job = StretchJob(
        str(folder / "drive.npz"), str(folder / "before.yaml"), (0.0, 0.0, 0.0), "amcl-defaults", LASER, 100
    )
    assert create_estimator(job).settings == ParticleFilterSettings(robot_model_type="omni")


def test_odometry_of_a_kidnapping():
    rng = np.random.default_rng(0)
    odom = np.cumsum(rng.normal(0, 0.1, (20, 3)), axis=0)
    hidden = hide_kidnapping(odom, 12)
    assert hidden[:12] == pytest.approx(odom[:12])
    assert hidden[12] == pytest.approx(odom[11])
    assert se2.between(hidden[12], hidden[15]) == pytest.approx(se2.between(odom[12], odom[15]))
    odom[[0, 11, 12]] = np.nan  # unknown
    hidden = hide_kidnapping(odom, 12)
    assert hidden[13] == pytest.approx(hidden[10])
    assert np.isnan(hidden).all(axis=1).nonzero()[0].tolist() == [0, 11, 12]


def test_unknown_odometry(folder, tmp_path):
    drive = real_drive.drive(200)
    drive = replace(drive, odom=np.where(np.arange(200)[:, None] % 50 < 5, np.nan, drive.odom))
    real_drive.save(tmp_path / "gaps.npz", drive)
    job = StretchJob(
        str(tmp_path / "gaps.npz"), str(folder / "before.yaml"), (0.0, 0.0, 0.0), "precise", ODOMETRY, 100, 30,
        model=str(folder / "before-precise.safetensors"),
    )  # fmt: skip
    assert real.summarise([one_trial(job)])["error_median_m"] < 0.05


def test_time_of_a_kidnapping(folder):
    job = StretchJob(
        str(folder / "drive.npz"), str(folder / "before.yaml"), (0.0, 0.0, 0.0), "precise", KIDNAPPED, 155, to=100,
        model=str(folder / "before-precise.safetensors"),
    )  # fmt: skip
    stamps = np.array(one_trial(job)["stamp_s"])
    assert (np.diff(stamps) > 0).all()
    assert np.diff(stamps).max() < 3 * np.median(np.diff(stamps))


@pytest.mark.parametrize("count", [20, 21])
def test_halves(count):
    drive = real_drive.drive(count)
    first, second = split(drive)
    assert len(first.ranges) == count // 2
    assert np.concatenate([first.stamps, second.stamps]) == pytest.approx(drive.stamps)


@pytest.mark.parametrize("count", [100, 101])
@pytest.mark.parametrize("exchanged", [False, True])
def test_scans_of_training(tmp_path, count, exchanged):
    log = tmp_path / "drive.npz"
    real_drive.save(log, real_drive.drive(count))
    first, second = split(drive_at(str(log), None, exchanged=False))
    learned, localised = (second, first) if exchanged else (first, second)
    job = StretchJob(str(log), "", None, "precise", LASER, 0, exchanged=exchanged)
    assert job.drive.poses[: job.learned] == pytest.approx(learned.poses)
    assert job.drive.poses[job.learned :] == pytest.approx(localised.poses)
    assert job.drive.odom[job.learned :] == pytest.approx(localised.odom)
    steps = se2.between(job.drive.poses[job.learned : -1], job.drive.poses[job.learned + 1 :])
    assert np.hypot(steps[:, 0], steps[:, 1]).max() < 0.4  # the robot drives at most 0.2 m between two scans


def test_localised_half(folder):
    where, mount = str(folder / "drive.npz"), (0.0, 0.0, 0.0)
    job = StretchJob(
        where, str(folder / "before.yaml"), mount, "precise", LASER, 100, 30,
        model=str(folder / "before-precise.safetensors"), exchanged=True,
    )  # fmt: skip
    found = real.summarise([one_trial(job)])  # by a model of these very scans
    assert found["error_median_m"] < 0.05
    assert job.drive.poses[100] == pytest.approx(drive_at(where, mount, exchanged=False).poses[0])
    assert real.RealLogJob(folder / "drive.npz", "map.yaml", exchange=True).result == "real-drive_exchanged"


def row(task, error, state, stamps=None):
    count = len(error)
    return {
        "task": task, "estimator": "precise", "error_m": error, "yaw_error_rad": [0.0] * count, "state": state,
        "stamp_s": stamps or [0.5 * k for k in range(count)], "nees": [3.0] * count, "ms": [1.0] * count,
    }  # fmt: skip


def test_durations_of_wrong_tracking():
    t, lost = "tracking", "lost"
    found = real.summarise([row("odometry", [0, 9, 9, 9, 9, 0, 9], [t, t, t, t, lost, t, t])])
    assert found["longest_wrong_s"] == pytest.approx(1.5)  # from the second to the fifth scan
    assert (found["scans"], found["correct"], found["tracking"], found["wrong"]) == (7, 2, 6, 4)
    single = real.summarise([row("odometry", [0, 9, 0], [t, t, t], [0.0, 1.0, 1.4])])
    assert single["longest_wrong_s"] == pytest.approx(0.4)
    searched = real.summarise([row("global", [9, 9, 0.1, 0], [lost, t, lost, t]), row("global", [9, 9], [lost, lost])])
    assert searched["found"] == 1
    assert searched["scans_until_found_median"] == 4


def test_headings_count():
    turned = row("global", [0, 0], ["tracking"] * 2) | {"yaw_error_rad": [0.2, 0.1]}
    found = real.summarise([turned])
    assert (found["correct"], found["wrong"], found["scans_until_found_median"]) == (1, 1, 2)
    assert real_tuning._tracking_score([turned])[0] == 0.5
    assert real_tuning._search_score([turned]) == (1.0, -2.0)


def test_stretches():
    job = real.RealLogJob(Path("drive.npz"), "map.yaml", every=10)
    found = real.stretches(StretchJob("", "", None, "precise", "", 0), 200, 400, job, odometry=True)
    assert [each.count for each in found[:2]] == [200, 200]
    kidnappings = [each for each in found if each.task == KIDNAPPED]
    assert found[2 : 2 + len(kidnappings)] == kidnappings
    for each in kidnappings:  # the scans after a kidnapping are in the same half, and none of those before it
        assert 200 <= each.to <= 400 - MAX_SEARCH_SCANS
        before = range(each.first, each.first + 10)
        assert not set(before) & set(range(each.to, each.to + MAX_SEARCH_SCANS))


def test_table():
    summary = {"a: tracking with odometry, precise": real.summarise([row("odometry", [0.01, 9], ["tracking"] * 2)])}
    table = real.table(summary)
    assert "| a, precise | 4505 | 50.0% | 100.0%, 50.0%; 0.5 | – | 3.00 |" in table


def test_short_log(folder, tmp_path):
    real_drive.save(tmp_path / "few.npz", real_drive.drive(100))
    job = real.RealLogJob(tmp_path / "few.npz", str(folder / "before.yaml"))
    with pytest.raises(UserError, match="100 posed scans; at least 160"):
        real.run(job, tmp_path, 1, Console(quiet=True))


def test_map_of_another_place(folder, tmp_path):
    elsewhere = World(name="elsewhere", boundary=[(50, 50), (60, 50), (60, 60), (50, 60)])
    (tmp_path / "elsewhere.yaml").write_text(save_world(elsewhere), encoding="utf-8")
    job = real.RealLogJob(folder / "drive.npz", str(tmp_path / "elsewhere.yaml"), (0.0, 0.0, 0.0))
    with pytest.raises(UserError, match=r"only 0% of the reference poses .* in free space"):
        real.run(job, tmp_path, 1, Console(quiet=True))
