"""Scanners by name and from files, and their beam directions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from common.geometry import se2
from common.robot.scan_geometry import ALL_ROUND, Sweep
from common.robot.scanner import SCANNERS
from common.robot.scanner_options import build_scanner, load_scanner
from common.runtime.config import load_settings
from services.simulator.settings import SimulatorSettings

TIM571 = SCANNERS["tim571"]
FILE = """
name: mine
beams: 720
fov_deg: 359.5
first_deg: 0
rate: 10
range_min: 0.1
range_max: 8
sigma: 0.01
mount: {x: 0.1, yaw_deg: 90}
upside_down: true
"""


def sweep_of(scanner):
    return Sweep(scanner.angle_min, scanner.angle_increment, scanner.beams)


def test_field_of_view_with_fewer_beams():
    few = TIM571.with_beams(91)
    assert len(few.angles()) == 91
    assert few.angles()[[0, -1]] == pytest.approx(TIM571.angles()[[0, -1]])
    assert np.ptp(few.angles()) == pytest.approx(np.deg2rad(270))
    assert TIM571.with_beams(None) is TIM571


@pytest.mark.parametrize("beams", [-1, 1, 1_000_000])
def test_invalid_numbers_of_beams(beams):
    with pytest.raises(UserError, match=f"tim571 with {beams} beams: beams: must be at") as error:
        TIM571.with_beams(beams)
    assert "\n" not in str(error.value)


def test_full_circle_scans():
    angles = np.rad2deg(SCANNERS["rplidar-a1"].angles())
    assert angles[[0, -1]] == pytest.approx([-179, 180])
    assert np.diff(angles) == pytest.approx(1)
    assert [name for name, scanner in SCANNERS.items() if sweep_of(scanner).all_round] == ["rplidar-a1"]


def test_beams_run_clockwise_upside_down():
    scanner = TIM571.with_beams(4).model_copy(update={"first": 0.1, "upside_down": True})
    assert scanner.angles() == pytest.approx(-0.1 - TIM571.with_beams(4).angle_increment * np.arange(4))


def test_noise_can_grow_with_the_range():
    ranges = np.array([1.0, 10.0, np.inf])
    assert SCANNERS["rplidar-a1"].deviation(ranges) == pytest.approx([0.01, 0.1, np.inf], rel=2e-3)
    drawn = SCANNERS["rplidar-a1"].add_noise(np.tile(ranges, (4000, 1)), np.random.default_rng(0))
    assert drawn[:, :2].std(axis=0) == pytest.approx([0.01, 0.1], rel=0.05)
    assert np.isposinf(drawn[:, 2]).all()


@given(st.floats(-7, 7), st.floats(0.01, 0.2), st.booleans(), st.integers(2, 400))
def test_beams_are_found_by_direction(first, step, clockwise, beams):
    sweep = Sweep(first, -step if clockwise else step, min(beams, int(2 * np.pi / step)))
    bearings = sweep.first + sweep.increment * np.arange(sweep.beams)
    assert (sweep.beams_at(se2.wrap(bearings)) == np.arange(sweep.beams)).all()
    sector = sweep.sector(0.3)
    if sweep.all_round:
        assert sector == ALL_ROUND
    else:
        opposite = sweep.middle + np.pi
        assert sweep.beams_at(np.array([opposite]))[0] == -1
        assert np.abs(se2.wrap(bearings + 0.3 - sector.centre)).max() <= sector.half + 1e-9


def test_a_file_describes_a_scanner(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(FILE)
    scanner = build_scanner(str(file))
    assert np.rad2deg(scanner.angles()[[0, 1, -1]]) == pytest.approx([0, -0.5, -359.5])
    assert scanner.mount == pytest.approx((0.1, 0, np.pi / 2))
    assert "mine: 720 beams over 359.5 deg" in str(scanner)
    other = build_scanner(str(file), 100, 0.05, "0,-0.2,180", upside_down=False)
    assert (other.beams, other.sigma, other.upside_down) == (100, 0.05, False)
    assert other.mount == pytest.approx((0, -0.2, np.pi))


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (("beams: 720", "beams: 1"), "beams: must be at least 2, not 1"),
        (("sigma: 0.01", "sigma: wide"), "sigma: expected a number, not 'wide'"),
        (("fov_deg: 359.5", "fov_deg: 400"), r"fov_deg: must be at most 360, not 400 \(degrees\)"),
        (("rate: 10\n", ""), "rate: missing"),
        (("rate: 10", "speed: 10"), "rate: missing"),
        (("range_max: 8", "range_max: 0.1"), "range_max 0.1 m must be more than range_min 0.1 m"),
        (("x: 0.1", "z: 0.1"), "mount.z: unknown key"),
        (("name: mine", "name: [mine"), "not valid YAML"),
        ((FILE, "- 1"), "expected keys with values"),
        (("{x: 0.1, yaw_deg: 90}", "3"), r"mount: expected keys with values, such as {x: 1, y: 2}, not 3 \(m"),
    ],
)
def test_invalid_files_are_explained(tmp_path, change, wrong):
    file = tmp_path / "mine.yaml"
    file.write_text(FILE.replace(*change))
    with pytest.raises(UserError, match=wrong) as error:
        load_scanner(str(file))
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"name": "sonar"}, "choose one of tim571, ust-10lx, lms200, rplidar-a1, or give a file"),
        ({"name": "no/such.yaml"}, "choose one of"),
        ({"name": ""}, "cannot be read"),
        *(({"mount": mount}, "--mount '.*': give x,y") for mount in ("1", "a,b", "1,2,3,4")),
        ({"mount": "0,0,999999999"}, "scanner tim571: mount, entry 3: must be"),
        *(({"noise": noise}, "scanner tim571: sigma: ") for noise in (-1e-9, np.nan, np.inf)),
    ],
)
def test_invalid_options_are_explained(options, error):
    with pytest.raises(UserError, match=error):
        build_scanner(**{"name": "tim571", **options})


@pytest.mark.parametrize("noise", [-1.0, np.nan, np.inf])
def test_invalid_noise_settings_are_refused(noise):
    with pytest.raises(UserError, match=r"noise: must be .*--noise, PRESAGE_NOISE"):
        load_settings(SimulatorSettings, [f"--noise={noise}"])


def test_noise_option():
    scanner = build_scanner("rplidar-a1", 30, 0.0)
    assert (scanner.sigma, scanner.sigma_relative, scanner.beams) == (0, 0, 30)
