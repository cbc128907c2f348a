"""docs/settings.yaml lists every setting with its default."""

from __future__ import annotations

import pytest
import yaml

from common.runtime.config import load_section, load_settings
from presage.learning.options import TrainSettings
from presage.logs.options import LogSettings
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.settings import ControllerSettings
from services.estimator.settings import EstimatorSettings
from services.mapper.settings import MapperSettings
from services.recorder.settings import RecorderSettings
from services.simulator.settings import SimulatorSettings
from services.viewer.settings import ViewerSettings
from tests.conftest import ROOT

FILE = ROOT / "docs" / "settings.yaml"
SERVICES = [
    SimulatorSettings, EstimatorSettings, ControllerSettings, MapperSettings, RecorderSettings, ViewerSettings,
    BridgeRos2Settings,
]  # fmt: skip


@pytest.mark.parametrize("cls", SERVICES, ids=lambda cls: cls.service)
def test_settings_of_services(cls):
    listed = yaml.safe_load(FILE.read_text())
    named = {name for name, value in listed.items() if not isinstance(value, dict)} | listed[cls.service].keys()
    assert cls.model_fields.keys() - {"config", "print_config"} <= named
    assert load_settings(cls, ["--config", str(FILE)]).effective() == load_settings(cls, []).effective()


@pytest.mark.parametrize(("name", "cls"), [("log", LogSettings), ("train", TrainSettings)])
def test_settings_of_commands(name, cls):
    assert load_section(cls, FILE, name) == cls()
    assert cls.model_fields.keys() == yaml.safe_load(FILE.read_text())[name].keys()
