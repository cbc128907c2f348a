"""The scan matcher that searches the whole map."""

from __future__ import annotations

import numpy as np

from common.geometry.world import load_world
from lab.accuracy.correlative import CorrelativeMatcher, best_cell, pyramid
from lab.accuracy.scenes import Scene


def test_best_cell_of_an_exhaustive_search():
    rng = np.random.default_rng(0)
    scores = rng.random((40, 50)).astype(np.float32)
    free = np.zeros(scores.shape, bool)
    free[8:35, 9:44] = rng.random((27, 35)) < 0.5
    rows, columns = rng.integers(-5, 6, (2, 3, 9)).astype(np.int32)
    exhaustive = {
        (k, i, j): scores[i + rows[k], j + columns[k]].sum()
        for k in range(3)
        for i, j in zip(*np.nonzero(free), strict=True)
    }
    found = best_cell(pyramid(scores), pyramid(free.astype(np.float32)) > 0, rows, columns)
    assert tuple(map(int, found)) == max(exhaustive, key=exhaustive.get)


def test_one_scan_in_the_whole_map():
    scene = Scene.of(load_world("maze"), 200, 5000)
    matcher = CorrelativeMatcher(scene.world, scene.scanner.mount)
    poses = scene.poses(3)
    for pose, clean in zip(poses, scene.clean(poses), strict=True):
        matcher.restart()
        first = matcher.update(scene.observe(clean, 0.0))
        again = matcher.update(scene.observe(clean, 0.1))  # near the first one
        for posterior in (first, again):
            assert posterior.state == "tracking"
            assert np.hypot(*(posterior.pose - pose)[:2]) < 0.02
