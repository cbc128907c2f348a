"""docs/settings.yaml lists every setting with its default."""

from __future__ import annotations

import re

import pytest
import yaml

from common.errors import UserError
from common.router.router import RouterSettings
from common.runtime.config import load_section, load_settings
from presage.learning.options import TrainSettings
from presage.logs.options import LogSettings
from presage.terminal.settings_file import check_keys, check_variables
from services.bridge_ros2.settings import BridgeRos2Settings
from services.controller.settings import ControllerSettings
from services.estimator.settings import EstimatorSettings
from services.mapper.settings import MapperSettings
from services.recorder.replaying.service import ReplaySettings
from services.recorder.settings import RecorderSettings
from services.simulator.settings import SimulatorSettings
from services.viewer.settings import ViewerSettings
from tests.conftest import ROOT

FILE = ROOT / "docs" / "settings.yaml"
SERVICES = [
    SimulatorSettings, EstimatorSettings, ControllerSettings, MapperSettings, RecorderSettings, ViewerSettings,
    BridgeRos2Settings, RouterSettings, ReplaySettings,
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


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("max_sped: 0.3\n", "max_sped: unknown key; did you mean max_speed?"),
        ("simulatr: {beams: 1}\n", "simulatr: unknown key; did you mean simulator?"),
        ("image: map.pgm\nresolution: 0.05\n", "image: unknown key"),
    ],
)
def test_misspelt_keys(tmp_path, text, problem):
    file = tmp_path / "my.yaml"
    file.write_text(text)
    with pytest.raises(UserError, match=re.escape(problem)):
        check_keys(file)


def test_all_keys_are_known():
    assert check_keys(FILE) == FILE
    assert check_keys(None) is None


@pytest.mark.parametrize(
    ("variable", "meant"),
    [
        ("PRESAGE_MAX_SPED", "PRESAGE_MAX_SPEED"),
        ("PRESAGE_CONTROLER_MAX_SPEED", "PRESAGE_CONTROLLER_MAX_SPEED"),
        ("PRESAGE_ESTIMATOR_MODELL", "PRESAGE_ESTIMATOR_MODEL"),
    ],
)
def test_misspelt_variables(monkeypatch, variable, meant):
    monkeypatch.setenv(variable, "0.3")
    with pytest.raises(UserError, match=f"{variable}: there is no such setting; did you mean {meant}?"):
        check_variables()


@pytest.mark.parametrize("file", ["docker-compose.yml", "Makefile", "docs/deployment.md"])
def test_other_variables_are_not_taken_for_misspelt_ones(monkeypatch, file):
    for name in re.findall(r"PRESAGE_[A-Z0-9_]*[A-Z0-9]", (ROOT / file).read_text()):
        monkeypatch.setenv(name, "1")
    check_variables()
