"""Surfaces so far away that the beams on them are apart."""

from __future__ import annotations

import numpy as np
import pytest

from services.mapper.slam.elements import Elements, elements_of_scan
from services.mapper.slam.registration import MATCHED_M, Surface
from services.mapper.slam.submaps import PosedScans

ANGLES = np.deg2rad(np.arange(-60.0, 61.0))


@pytest.mark.parametrize("moved", [0.05, 0.13, 0.4])
def test_correspondences_between_beams(moved):
    wall = elements_of_scan(15 / np.cos(ANGLES), ANGLES, np.zeros(3), 80.0)
    again = wall.transformed(np.array([0.0, moved, 0.0]))
    assert (Surface(wall).correspondence_distances(again) < MATCHED_M).mean() > 0.95


@pytest.mark.parametrize(("seen", "free"), [(19.0, False), (24.0, False), (40.0, True)])
def test_grazing_beams(seen, free):
    scans = PosedScans(np.zeros((1, 3)), np.full((1, len(ANGLES)), seen), ANGLES)
    wall = Elements(np.array([[20.0, 1.0]]), np.array([[0.0, -1.0]]), np.array([0.1]), np.zeros(1))
    assert scans.see_through(wall).tolist() == [free]
