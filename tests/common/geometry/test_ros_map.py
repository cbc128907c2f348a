"""ROS maps: map_server's rules for single pixels, image formats, and invalid files."""

from __future__ import annotations

import os

import numpy as np
import pytest
import yaml
from PIL import Image

from common.errors import UserError
from common.geometry.occupancy_grid import FREE, OCCUPIED, UNKNOWN
from common.geometry.ros_map import MapFile, percentages
from common.geometry.world import load_world
from tests.common.geometry.maps import values_of, write_map, write_yaml

SHADES = np.arange(256, dtype=np.uint8).reshape(16, 16)
ALPHAS = np.random.default_rng(0).choice([0, 1, 128, 254, 255], (16, 16)).astype(np.uint8)


def expected(shade, alpha, mode, negate, low, high):
    """Occupancy of one pixel (0 to 255) as in nav2_map_server's map_io.cpp: 0 to 100, or -1."""
    level = shade / 255 if mode != "trinary" or alpha is None else (3 * shade + alpha) / 4 / 255
    occupied = level if negate else 1 - level
    if mode == "raw":
        return round(level * 255) if round(level * 255) <= 100 else -1
    if mode == "scale" and alpha is not None and alpha < 255:
        return -1
    if occupied > high:
        return 100
    if occupied < low:
        return 0
    return -1 if mode == "trinary" else round((occupied - low) / (high - low) * 100)


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("alpha", [None, ALPHAS])
@pytest.mark.parametrize("thresholds", [(0.25, 0.65), (0.196, 0.9)])
def test_percentages(mode, negate, alpha, thresholds):
    low, high = thresholds
    keys = {"negate": negate, "mode": mode, "free_thresh": low, "occupied_thresh": high}
    described = MapFile(image="x", resolution=1, origin=(0, 0, 0), **keys)
    colours = np.repeat(SHADES[..., None], 3, axis=-1) / 255
    found = percentages(described, colours, None if alpha is None else alpha / 255)
    one_by_one = [
        expected(int(s), None if alpha is None else int(a), mode, negate, low, high)
        for s, a in zip(SHADES.ravel(), ALPHAS.ravel(), strict=True)
    ]
    assert found.ravel().tolist() == one_by_one


def cells_of(folder, image, **keys):
    return load_world(str(write_yaml(folder, image=image, **keys))).grid.values


def test_map_saver_greys(tmp_path):
    values = values_of("#?. ..# ?.#")
    for low in (0.25, 0.196):
        world = load_world(str(write_map(tmp_path, values, free_thresh=low, origin=[-1, 2.5, 0], resolution=0.1)))
        assert np.array_equal(world.grid.values, values)
        assert world.name == "map"
        assert world.bounds == pytest.approx((-1, 2.5, -0.7, 2.8))
    # In an image that map_saver did not write, 205 is a grey like others.
    Image.fromarray(np.array([[0, 205, 254, 250]], np.uint8)).save(tmp_path / "own.png")
    assert cells_of(tmp_path, "own.png", free_thresh=0.25).tolist() == [[OCCUPIED, FREE, FREE, FREE]]


def test_modes(tmp_path):
    Image.fromarray(np.array([[0, 100, 150, 255]], np.uint8)).save(tmp_path / "m.png")
    assert cells_of(tmp_path, "m.png", mode="scale").tolist() == [[OCCUPIED, UNKNOWN, UNKNOWN, FREE]]
    assert cells_of(tmp_path, "m.png", mode="Trinary", negate=1).tolist() == [[FREE, UNKNOWN, UNKNOWN, OCCUPIED]]
    Image.fromarray(np.array([[0, 10, 50, 66, 100, 101]], np.uint8)).save(tmp_path / "m.png")
    raw = cells_of(tmp_path, "m.png", mode="raw").tolist()
    assert raw == [[FREE, FREE, UNKNOWN, OCCUPIED, OCCUPIED, UNKNOWN]]


@pytest.mark.parametrize(
    "kind", ["P2 255", "P2 65535", "P5", "L.png", "1.png", "RGB.png", "RGBA.png", "LA.png", "P.png", "16.png", "L.bmp"]
)
def test_image_formats(tmp_path, kind):
    dark, (mode, _, ending) = np.array([[0, 255, 255], [0, 0, 255]], np.uint8), kind.partition(".")
    path = tmp_path / f"map.{ending or 'pgm'}"
    if mode.startswith("P2"):
        white = int(mode.removeprefix("P2 "))
        pixels = " ".join(str(v * white // 255) for v in dark.ravel().tolist())
        path.write_text(f"P2\n# made by hand\n3 2\n{white}\n{pixels}")
    elif mode == "P5":
        path.write_bytes(b"P5 3 2 65535\n" + (dark.astype(">u2") * 257).tobytes())
    elif mode == "16":
        Image.fromarray(dark.astype(np.uint16) * 257).save(path)
    else:
        Image.fromarray(dark).convert(mode).save(path)
    assert cells_of(tmp_path, path.name).tolist() == [[OCCUPIED, OCCUPIED, FREE], [OCCUPIED, FREE, FREE]]


def test_keys_of_map_yaml(tmp_path):
    Image.fromarray(np.full((40, 40), 254, np.uint8)).save(tmp_path / "hall.png")
    path = tmp_path / "the hall.yaml"
    plain = {"image": "hall.png", "resolution": 0.1, "origin": [0, 0, 0.5], "other": "key"}
    path.write_text(yaml.safe_dump(plain))
    assert load_world(str(path)).name == "the-hall"
    own = {"name": "hall", "start": {"x": -0.5, "y": 2.0}, "obstacles": [{"circle": {"center": [0, 1], "radius": 0.3}}]}
    path.write_text(yaml.safe_dump(plain | own))
    hall = load_world(str(path))
    assert (hall.name, hall.start_pose(0.3).tolist()[:2], len(hall.circles)) == ("hall", [-0.5, 2.0], 1)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"image": "none.pgm"}, "none.pgm: no such file"),
        ({"image": "map.yaml"}, "not an image"),
        ({"image": "cut.png"}, "cut.png: cannot be read"),
        ({"image": "float.pgm"}, "float.pgm: cannot be read .its pixels are floating-point numbers"),
        ({"image": "pipe.pgm"}, r"map image .*pipe.pgm: a folder, pipe or device, not a file"),
        ({}, "image: missing"),
        ({"image": "map.pgm", "mode": "quaternary"}, "mode: .*'trinary', 'scale' or 'raw'"),
        ({"image": "map.pgm", "origin": [0, float("nan"), 0]}, "origin, entry 2: .*finite"),
        ({"image": "map.pgm", "resolution": 0}, "resolution: .*greater than 0"),
        ({"image": "map.pgm", "free_thresh": 0.7}, "free_thresh 0.7 must be below occupied_thresh 0.65"),
        ({"image": "map.pgm", "start": {"x": 1}}, "start.y: missing"),
    ],
)
def test_invalid_maps(tmp_path, keys, message):
    write_map(tmp_path, values_of("#.? ..."))
    Image.fromarray(ALPHAS).save(tmp_path / "cut.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "cut.png").read_bytes()[:100])
    (tmp_path / "float.pgm").write_bytes(b"Pf 1 1 -1.0\n" + np.float32(0.5).tobytes())
    os.mkfifo(tmp_path / "pipe.pgm")
    with pytest.raises(UserError, match=message):
        load_world(str(write_yaml(tmp_path, **keys)))


@pytest.mark.parametrize("side", [4001, 10_000, 14_000])  # Pillow warns of the second one, and refuses the third one
def test_too_large_images(tmp_path, side):
    Image.new("1", (side, side)).save(tmp_path / "huge.png")
    with pytest.raises(UserError, match=r"huge.png: more than 16000000 pixels; crop it"):
        load_world(str(write_yaml(tmp_path, image="huge.png")))


def test_image_instead_of_yaml(tmp_path):
    write_map(tmp_path, values_of("#.? ..."))
    with pytest.raises(UserError, match=r"map.pgm: an image: give the map.yaml that names it, such as .*map.yaml"):
        load_world(str(tmp_path / "map.pgm"))
