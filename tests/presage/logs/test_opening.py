"""The format of a file, and one-line errors for cut, damaged and foreign ones."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from presage.logs.log import Reading
from presage.logs.opening import kind_of, open_log
from presage.logs.scan_files import read_scans
from tests.presage.logs.drives import ANGLES, MOUNT, SCANS, STAMPS, Bag, carmen, odom, ranges, truth, write_bag
from tests.recorder.sessions import write as write_recording

CUTS = 8  # places at which a file is cut, and at which one is damaged


def npz(folder):
    file = folder / "drive.npz"
    np.savez_compressed(
        file, ranges=ranges(), angles=ANGLES, range_max=25.0, stamps=(STAMPS - STAMPS[0]) * 1e-9, odom=odom(STAMPS),
        reference=truth(STAMPS),
    )  # fmt: skip
    return file


def log(folder):
    file = folder / "drive.log"
    file.write_text("\n".join(carmen()) + "\n")
    return file


def bag(form):
    def make(folder):
        path = write_bag(folder, Bag(form))
        return path if form == "ros1" else next(path.glob(f"*.{form}"))

    return make


MAKERS = {"npz": npz, "carmen": log, "ros1": bag("ros1"), "db3": bag("db3"), "mcap": bag("mcap")}


@pytest.mark.parametrize("name", MAKERS)
def test_format_by_content(tmp_path, name):
    file = MAKERS[name](tmp_path)
    kind = {"db3": "ros2", "mcap": "ros2"}.get(name, name)
    assert kind_of(file) == kind
    if kind != "ros2":  # its reader needs the suffix
        assert kind_of(file.rename(tmp_path / "anything.dat")) == kind


def test_unknown_array(tmp_path):
    np.savez(tmp_path / "drive.npz", ranges=ranges(), angles=ANGLES, range_max=25.0, truth=truth(STAMPS))
    assert read_scans(tmp_path / "drive.npz").notes[0].startswith("not used: truth; the arrays of an .npz file are ")


def test_recording_is_no_log(tmp_path):
    file = write_recording(tmp_path / "run.mcap")
    assert kind_of(file) == "recording"
    with pytest.raises(UserError, match="is a presage recording already"):
        open_log(file, Reading())


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty"),
        (b"\xff\xd8\xff\xe0\x00\x10JFIF", r"not a presage recording.*begins with b'.xff.xd8"),
        (b"a letter\nto nobody\n", "not a presage recording"),
        (b"#ROSBAG V1.2\n", "before 2010"),
        (b"\x28\xb5\x2f\xfd\x00", "name its folder"),
        (b"\x1f\x8b\x08", "cut short"),
        (b"#ROSBAG V2.0\n", "ROS bag that cannot be read"),
        (b"\x89MCAP0\r\n", "rename it to NAME.mcap"),
        (b"PK\x03\x04 not really", "not an .npz"),
    ],
)
def test_unknown_contents(tmp_path, content, why):
    file = tmp_path / "drive.bag"
    file.write_bytes(content)
    with pytest.raises(UserError, match=why):
        list(open_log(file, Reading()).valid_scans())
    with pytest.raises(UserError, match=why):
        read_scans(file, MOUNT)


def test_missing_files(tmp_path):
    with pytest.raises(UserError, match="no such file"):
        kind_of(tmp_path / "no.bag")
    with pytest.raises(UserError, match=r"without metadata.yaml"):
        kind_of(tmp_path)
    (tmp_path / "metadata.yaml").write_text("{")
    with pytest.raises(UserError, match="ROS bag that cannot be read"):
        open_log(tmp_path, Reading())


@pytest.mark.parametrize("name", MAKERS)
def test_cuts_and_damage(tmp_path, name):
    file = MAKERS[name](tmp_path)
    whole = file.read_bytes()
    rng, refused = np.random.default_rng(0), 0
    for at in np.linspace(1, len(whole) - 2, CUTS).astype(int):
        damaged = bytearray(whole)
        damaged[at : at + 16] = rng.bytes(len(damaged[at : at + 16]))
        for content in (whole[:at], bytes(damaged)):
            file.write_bytes(content)
            try:
                scans = read_scans(file)
                assert 0 < len(scans.ranges) <= SCANS
            except UserError as error:
                refused += 1
                assert str(file) in str(error)  # noqa: PT017
    assert refused >= (1 if name == "carmen" else CUTS // 2)  # of a text the lines before a cut are whole
