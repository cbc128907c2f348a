"""Limits of the robot: the same settings in all services, checked at the start."""

from __future__ import annotations

import pytest

from common.errors import UserError
from common.robot.robot import Robot
from common.runtime.config import load_settings
from common.runtime.robot_settings import RobotSettings
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.settings import ControllerSettings
from services.simulator.settings import SimulatorSettings

ALL = [ControllerSettings, SimulatorSettings, BridgeRos2Settings]
BURGER = ["--drive=differential", "--radius=0.105", "--max-speed=0.22", "--max-turn=2.84", "--acceleration=0.5"]


@pytest.mark.parametrize("settings", ALL)
def test_the_default_robot(settings):
    assert load_settings(settings, []).build_robot() == Robot()


@pytest.mark.parametrize("settings", ALL)
def test_settings_define_the_robot(settings):
    robot = load_settings(settings, [*BURGER, "--turn-acceleration=3.2"]).build_robot()
    assert robot == Robot(
        drive="differential", radius=0.105, max_speed=0.22, max_turn=2.84, acceleration=0.5, turn_acceleration=3.2
    )


def test_the_environment_sets_all_services(monkeypatch):
    for name, value in {"RADIUS": "0.105", "MAX_SPEED": "0.22", "MAX_TURN": "2.84", "DRIVE": "differential"}.items():
        monkeypatch.setenv(f"PRESAGE_{name}", value)
    monkeypatch.setenv("PRESAGE_ACCELERATION", "")  # as compose passes what is not set
    one, two, three = (load_settings(each, []).build_robot() for each in ALL)
    assert one == two == three
    assert (one.radius, one.max_speed, one.max_turn, one.acceleration) == (0.105, 0.22, 2.84, 1.0)


@pytest.mark.parametrize("field", ["radius", "max_speed", "max_turn", "acceleration", "turn_acceleration"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf", "1e9", "quick"])
def test_invalid_limits_are_named(field, value):
    with pytest.raises(UserError, match=f"{field}: .*--{field.replace('_', '-')}, PRESAGE_{field.upper()}"):
        load_settings(ControllerSettings, [f"--{field.replace('_', '-')}={value}"])


def test_dead_band_above_the_maximum_speed():
    with pytest.raises(UserError, match=r"--dead-band 0.1 with --max-speed 0.1: the robot would never move"):
        RobotSettings(dead_band=0.1, max_speed=0.1).build_robot()
    with pytest.raises(UserError, match="--turn-dead-band"):
        RobotSettings(turn_dead_band=0.5, max_turn=0.4).build_robot()


def test_slowly_stopping_robots():
    with pytest.raises(UserError, match=r"--max-speed 1 m/s with --acceleration 0.01 m/s²: .* 100 s to stop"):
        RobotSettings(acceleration=0.01).build_robot()
    with pytest.raises(UserError, match="--turn-acceleration"):
        RobotSettings(turn_acceleration=0.1).build_robot()
