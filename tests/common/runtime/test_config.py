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
from common.geometry.pose_text import POSE_PATTERN, parse_initial_pose, parse_pose
from common.router.router import RouterSettings
from common.runtime.config import ServiceSettings, load_section, load_settings
from presage.logs.options import LogSettings


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
def load(tmp_path):
    """Loads the settings from arguments and the text of a settings file."""

    def run(*argv, file="", cls=Settings):
        (tmp_path / "settings.yaml").write_text(file)
        return load_settings(cls, [*argv, *(["--config", str(tmp_path / "settings.yaml")] if file else [])])

    return run


def test_defaults(load):
    settings = load()
    assert (settings.size, settings.label, settings.ratio) == (1, "plain", None)
    assert settings.link() == Link("robot", (DEFAULT_ENDPOINT,), ("tcp/127.0.0.1:0",), lossless=False)


def test_precedence(load, monkeypatch):
    file = "size: 2\nlabel: file\nratio: 0.5\n"
    assert load(file=file).size == 2
    monkeypatch.setenv("PRESAGE_SIZE", "3")
    assert load(file=file).size == 3
    settings = load("--size", "4", file=file)
    assert (settings.size, settings.label, settings.ratio, settings.log_level) == (4, "file", 0.5, "info")
    monkeypatch.delenv("PRESAGE_SIZE")
    assert load().size == 1  # the file of an earlier call has no effect


def test_the_section_overrides_the_top_level(load):
    text = "size: 2\nlabel: shared\nalpha: 0.1\nthing: {size: 5}\nestimator: {alpha: 1, nonsense: 2}\n"
    settings = load(file=text)
    assert (settings.size, settings.label) == (5, "shared")


@pytest.mark.parametrize("given", [["--label", "-3,1.5"], ["--label=-3,1.5"]])
def test_a_value_may_begin_with_a_minus(load, given):
    settings = load("--ratio", "-.5", *given, "--size", "3")
    assert (settings.label, settings.ratio) == ("-3,1.5", -0.5)


@pytest.mark.parametrize(
    ("text", "pose"),
    [("1,-2.5", [1, -2.5, 0]), ("-3,1.5,-90", [-3, 1.5, -np.pi / 2]), (".5,-2.", [0.5, -2, 0]), ("", None)],
)
def test_pose_texts(text, pose):
    assert re.match(POSE_PATTERN, text)
    if pose is not None:
        np.testing.assert_allclose(parse_pose(text, "--start"), pose)
        heading = text.count(",") == 2  # without it, a start has an unknown one
        np.testing.assert_allclose(parse_initial_pose(text, "--start"), pose if heading else pose[:2])


@pytest.mark.parametrize("text", ["1.2.3,1", "1", ".,1", "nan,1", "1,2,3,4", "1,,2", "-,1", "1e3,1"])
def test_invalid_poses(text):
    assert not re.match(POSE_PATTERN, text)
    with pytest.raises(UserError, match=r"--mount '.*': give x,y\[,yaw_deg\] in m and degrees"):
        parse_pose(text, "--mount")
    with pytest.raises(UserError, match=r"mount: give x,y\[,yaw_deg\] in m and degrees, such as 0.2,0,180, not"):
        load_section(LogSettings, None, "log", mount=text)


def test_poses_beyond_the_limits():
    with pytest.raises(UserError, match=r"--start '999999999,1': x and y must be within 10000 m of the origin"):
        parse_pose("999999999,1", "--start")


def test_empty_values_count_only_as_arguments(load, monkeypatch):
    assert load("--label", "", "--connect=").label == ""
    assert load("--connect", "").link().connect == ()
    monkeypatch.setenv("PRESAGE_LABEL", "")
    monkeypatch.setenv("PRESAGE_SIZE", "")
    assert (load().label, load().size) == ("plain", 1)


@pytest.mark.parametrize(
    ("argv", "file", "words"),
    [
        (["--size", "101"], "", ["size", "must be at most 100", "--size", "PRESAGE_SIZE"]),
        (["--size", "many"], "", ["size: expected a whole number, not 'many'"]),
        (["--robot", "a/b"], "", ["robot", "--robot", "PRESAGE_ROBOT"]),
        (["--robot", "*"], "", ["robot: '*' is not valid; expected: name of the robot"]),
        (["--config", "nowhere.yaml"], "", ["nowhere.yaml", "cannot be read"]),
        ([], "size: [", ["not valid YAML"]),
        ([], "size: 1\nlabel: a\nsize: 2\n", ["settings.yaml: not valid YAML (line 3: 'size' is given twice)"]),
        ([], "- 1\n- 2\n", ["a mapping of settings"]),
        ([], "thing: 7\n", ["thing", "a mapping of settings"]),
        ([], "thing: {colour: red}\n", ["colour: unknown key (", "settings.yaml"]),
        ([], "thing: {sise: 1}\n", ["sise: unknown key; did you mean size?", "settings.yaml"]),
        ([], "label: 2020-13-45\n", ["settings.yaml: not valid YAML", "month"]),
        ([], "[" * 20_000, ["settings.yaml: not valid YAML"]),
    ],
)
def test_mistakes_are_one_line(load, argv, file, words):
    with pytest.raises(UserError) as caught:
        load(*argv, file=file)
    assert "\n" not in str(caught.value)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_binary_files(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(UserError, match=r"binary\.yaml: not valid YAML"):
        load_settings(Settings, ["--config", str(tmp_path / "binary.yaml")])


def test_environment_variables(load, monkeypatch):
    monkeypatch.setenv("PRESAGE_ALPHA", "x")
    monkeypatch.setenv("PRESAGE_SIZE", "-1")  # for all services
    monkeypatch.setenv("PRESAGE_THING_SIZE", "7")  # for this one
    assert load().size == 7
    monkeypatch.delenv("PRESAGE_THING_SIZE")
    with pytest.raises(UserError, match="PRESAGE_SIZE"):
        load()


def test_unknown_options(load, capsys):
    with pytest.raises(SystemExit) as ended:
        load("--colour", "red")
    assert ended.value.code == 2
    assert "unrecognized arguments: --colour" in capsys.readouterr().err


def test_print_config(load, capsys):
    given = ("--size", "4", "--ratio", "0.25")
    with pytest.raises(SystemExit) as ended:
        load(*given, "--print-config")
    assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert yaml.safe_load(printed)["thing"]["size"] == 4
    assert load(file=printed).effective() == load(*given).effective()


def test_help(load, capsys):
    for cls in (Settings, RouterSettings):
        with pytest.raises(SystemExit):
            load("--help", cls=cls)
    text = capsys.readouterr().out
    for part in ("usage: python -m services.thing", "python -m services.thing --size 3", "how large", "--log-json"):
        assert part in text
    assert "--robot" not in text.partition("usage: python -m common.router")[2]


def test_settings_of_a_router(load, monkeypatch):
    monkeypatch.setenv("PRESAGE_CONNECT", "tcp/127.0.0.1:1")
    monkeypatch.setenv("PRESAGE_LISTEN", "tcp/127.0.0.1:2")
    shared = "listen: tcp/127.0.0.1:3\n"
    assert load(file=shared, cls=RouterSettings).link() == Link("robot", (), (DEFAULT_ENDPOINT,), router=True)
    own = shared + "router: {listen: 'tcp/127.0.0.1:4'}\n"
    assert load(file=own, cls=RouterSettings).listen == "tcp/127.0.0.1:4"
    monkeypatch.setenv("PRESAGE_ROUTER_LISTEN", "tcp/127.0.0.1:5")
    assert load(file=own, cls=RouterSettings).listen == "tcp/127.0.0.1:5"
    assert load("--listen", "tcp/127.0.0.1:6", file=own, cls=RouterSettings).listen == "tcp/127.0.0.1:6"
    with pytest.raises(UserError, match="PRESAGE_ROUTER_LISTEN"):
        load("--listen", "", cls=RouterSettings)
