"""Settings: precedence of their sources, and messages for invalid ones."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

import numpy as np
import pytest
import yaml
from pydantic import Field

from common.bus.bus import DEFAULT_ENDPOINT, Link
from common.errors import UserError
from common.geometry.pose_text import POSE_TEXT, pose_of_text
from common.router.router import RouterSettings
from common.runtime.config import ServiceSettings, load_settings, split_endpoints


class Settings(ServiceSettings):
    """Settings for tests.

    examples:
      python -m services.thing --size 3
    """

    service: ClassVar[str] = "thing"

    size: Annotated[int, Field(ge=0, le=100, description="how large")] = 1
    label: Annotated[str, Field(description="what it is called")] = "plain"
    ratio: float | None = None


@pytest.fixture
def file(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / "settings.yaml"
        path.write_text(text)
        return str(path)

    return write


def test_defaults():
    settings = load_settings(Settings, [])
    assert (settings.size, settings.label, settings.ratio) == (1, "plain", None)
    assert settings.link() == Link("robot", (DEFAULT_ENDPOINT,), ("tcp/127.0.0.1:0",), lossless=False)


def test_precedence_of_sources(file, monkeypatch):
    config = ["--config", file("size: 2\nlabel: file\nratio: 0.5\n")]
    assert load_settings(Settings, config).size == 2
    monkeypatch.setenv("PRESAGE_SIZE", "3")
    assert load_settings(Settings, config).size == 3
    assert load_settings(Settings, [*config, "--size", "4"]).size == 4
    settings = load_settings(Settings, [*config, "--size", "4"])
    assert (settings.label, settings.ratio, settings.log_level) == ("file", 0.5, "info")
    monkeypatch.delenv("PRESAGE_SIZE")
    assert load_settings(Settings, []).size == 1  # files do not affect later calls


def test_the_services_section_overrides_the_top_level(file):
    text = "size: 2\nlabel: shared\nalpha: 0.1\nthing: {size: 5}\nestimator: {alpha: 1, nonsense: 2}\n"
    settings = load_settings(Settings, ["--config", file(text)])
    assert (settings.size, settings.label) == (5, "shared")


@pytest.mark.parametrize("given", [["--label", "-3,1.5"], ["--label=-3,1.5"]])
def test_a_value_may_begin_with_a_minus(given):
    assert load_settings(Settings, [*given, "--size", "3"]).label == "-3,1.5"
    assert load_settings(Settings, ["--ratio", "-.5", *given]).ratio == -0.5


@pytest.mark.parametrize("text", ["3,1.5", "-3,1.5,-90", ".5,-2.", ""])
def test_pose_texts(text):
    assert re.match(POSE_TEXT, text)
    assert all(np.isfinite(float(part)) for part in text.split(",") if part)


@pytest.mark.parametrize("text", ["1.2.3,1", "1", ".,1", "nan,1", "1,2,3,4", "1,,2", "-,1", "1e3,1"])
def test_invalid_poses_are_refused(text):
    assert not re.match(POSE_TEXT, text)
    with pytest.raises(UserError, match=r"--mount '.*': give x,y\[,yaw_deg\] in m and degrees"):
        pose_of_text(text, "--mount")


def test_poses_are_converted_to_radians():
    np.testing.assert_allclose(pose_of_text("1,-2.5", "--start"), [1, -2.5, 0])
    np.testing.assert_allclose(pose_of_text("1,2,-90", "--start"), [1, 2, -np.pi / 2])
    with pytest.raises(UserError, match=r"--start '999999999,1': x and y must be within 10000 m of the origin"):
        pose_of_text("999999999,1", "--start")


def test_empty_values_are_ignored_only_in_the_environment(monkeypatch):
    assert load_settings(Settings, ["--label", "", "--connect="]).label == ""
    assert load_settings(Settings, ["--connect", ""]).link().connect == ()
    monkeypatch.setenv("PRESAGE_LABEL", "")
    monkeypatch.setenv("PRESAGE_SIZE", "")
    assert load_settings(Settings, []).label == "plain"
    assert load_settings(Settings, []).size == 1


def error_of(argv, settings=Settings) -> str:
    with pytest.raises(UserError) as caught:
        load_settings(settings, argv)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--size", "101"], ["size", "less than or equal to 100", "--size", "PRESAGE_SIZE"]),
        (["--size", "many"], ["size", "integer", "--size"]),
        (["--robot", "a/b"], ["robot", "--robot", "PRESAGE_ROBOT"]),
        (["--robot", "*"], ["robot: '*' is not valid; expected: name of the robot"]),
        (["--log-level", "loud"], ["--log-level", "PRESAGE_LOG_LEVEL"]),
        (["--config", "nowhere.yaml"], ["nowhere.yaml", "cannot be read"]),
    ],
)
def test_invalid_arguments(argv, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert all(word in error_of(argv) for word in words), error_of(argv)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"size: [", "not valid YAML"),
        (b"- 1\n- 2\n", "a mapping of settings"),
        (b"thing: 7\n", "a mapping of settings"),
        (b"thing: {colour: red}\n", "colour"),
        (b"size: 1000\n", "size"),
        (b"\xff\xfe\x00\x80", "not valid YAML"),
        (b"label: 2020-13-45\n", "month"),
        (b"[" * 20_000, "not valid YAML"),
    ],
)
def test_invalid_files(tmp_path, content, words):
    path = tmp_path / "settings.yaml"
    path.write_bytes(content)
    error = error_of(["--config", str(path)])
    assert words in error
    assert "settings.yaml" in error


def test_variables(monkeypatch):
    monkeypatch.setenv("PRESAGE_ALPHA", "x")
    monkeypatch.setenv("PRESAGE_THING_SIZE", "7")  # only private fields have such names
    assert load_settings(Settings, []).size == 1
    monkeypatch.setenv("PRESAGE_SIZE", "-1")
    assert "PRESAGE_SIZE" in error_of([])


def test_an_unknown_option_ends_with_status_2(capsys):
    with pytest.raises(SystemExit) as ended:
        load_settings(Settings, ["--colour", "red"])
    assert ended.value.code == 2
    assert "unrecognized arguments: --colour" in capsys.readouterr().err


def test_print_config_prints_the_settings_as_yaml(file, capsys):
    with pytest.raises(SystemExit) as ended:
        load_settings(Settings, ["--size", "4", "--ratio", "0.25", "--print-config"])
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert yaml.safe_load(printed)["thing"]["size"] == 4
    again = load_settings(Settings, ["--config", file(printed)])
    assert again.effective() == load_settings(Settings, ["--size", "4", "--ratio", "0.25"]).effective()


def test_help_shows_program_settings_and_examples(capsys):
    with pytest.raises(SystemExit) as ended:
        load_settings(Settings, ["--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert "usage: python -m services.thing" in text
    assert "python -m services.thing --size 3" in text
    assert "how large" in text
    for name in Settings.model_fields:
        assert f"--{name.replace('_', '-')}" in text


def test_endpoints_are_split_at_commas():
    assert split_endpoints(" tcp/a:1, tcp/b:2,, ") == ("tcp/a:1", "tcp/b:2")
    assert split_endpoints("") == ()


def test_a_router_ignores_the_settings_of_services(file, monkeypatch):
    monkeypatch.setenv("PRESAGE_CONNECT", "tcp/127.0.0.1:1")
    monkeypatch.setenv("PRESAGE_LISTEN", "tcp/127.0.0.1:2")
    shared = ["--config", file("listen: tcp/127.0.0.1:3\n")]
    assert load_settings(RouterSettings, shared).link() == Link("robot", (), (DEFAULT_ENDPOINT,), router=True)
    own = ["--config", file("listen: tcp/127.0.0.1:3\nrouter: {listen: 'tcp/127.0.0.1:4'}\n")]
    assert load_settings(RouterSettings, own).listen == "tcp/127.0.0.1:4"
    monkeypatch.setenv("PRESAGE_ROUTER_LISTEN", "tcp/127.0.0.1:5")
    assert load_settings(RouterSettings, own).listen == "tcp/127.0.0.1:5"
    assert load_settings(RouterSettings, [*own, "--listen", "tcp/127.0.0.1:6"]).listen == "tcp/127.0.0.1:6"


def test_a_routers_errors_and_help_name_its_variables(capsys):
    assert "PRESAGE_ROUTER_LISTEN" in error_of(["--listen", ""], RouterSettings)
    with pytest.raises(SystemExit):
        load_settings(RouterSettings, ["--help"])
    text = capsys.readouterr().out
    assert "usage: python -m common.router" in text
    assert "--robot" not in text
