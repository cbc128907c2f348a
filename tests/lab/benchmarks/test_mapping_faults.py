"""`presage bench mapping-faults`."""

from __future__ import annotations

import pytest

from lab.benchmarks import mapping_faults
from lab.benchmarks.mapping_faults import make_drive, map_drive, table
from services.mapper.slam.trajectory import build_trajectory


@pytest.fixture(scope="module")
def drive():
    return make_drive("carried to a mapped place", 5003, 20)


def test_disturbance_is_in_the_middle(drive):
    assert drive.undisturbed == len(drive.truth) // 2
    jump = drive.truth[drive.undisturbed] - drive.truth[drive.undisturbed - 1]
    assert abs(jump[:2]).max() > 0.5


def test_wrong_places(drive, monkeypatch):
    """A quarter of the scans is placed 3 m from where they were taken; the errors of the others stay small."""

    def build_wrongly(raw):
        built = build_trajectory(raw)
        built.poses[:] = drive.truth
        built.poses[3 * len(built.poses) // 4 :, 0] += 3
        return built

    monkeypatch.setattr(mapping_faults, "build_trajectory", build_wrongly)
    row = map_drive(drive, odometry=True)
    assert row["wrong_place"] == pytest.approx(0.25, abs=0.01)
    assert row["position_max_m"] < 1e-6
    text = table([{"case": case, **row} for case in mapping_faults.CASES])
    assert "| carried to a mapped place | 100 | 25 | 0.00 |" in text
