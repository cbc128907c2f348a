"""Mistakes that `presage up` reports before it starts anything."""

from __future__ import annotations

import pytest

from common.errors import UserError
from common.geometry.world import load_world, save_world
from presage.session.session_plan import plan_session


def plan(world="", drive="", simulator=(), estimator=(), *, config=None, mapping=False):
    return plan_session(config, world, drive, simulator, estimator, mapping=mapping)


def test_arguments_of_services(tmp_path, monkeypatch):
    config = tmp_path / "c.yaml"
    config.write_text("world: office\nsimulator: {pace: lockstep, people: 3}\nestimator: {estimator: particle-filter}")
    monkeypatch.setenv("PRESAGE_PEOPLE", "2")
    planned = plan(config=config, drive="differential")
    assert planned.estimator_settings.world == "office"
    assert planned.simulator_settings.people == 2
    common = (f"--config={config}",)
    assert planned.estimator == common
    assert planned.controller == (*common, "--drive=differential", "--belief-timeout=20.0")
    assert plan(estimator=["--estimator=paper"]).controller == ("--preset=paper",)


@pytest.mark.parametrize(
    ("wrong", "says", "variables"),
    [
        ({"estimator": ["--estimator", "presice"]}, "estimator: .*'precise'.*--estimator", {}),
        ({"estimator": ["--model", "exakt"]}, "no model 'exakt': give learned, exact", {}),
        ({"estimator": ["--model", "no.safetensors"]}, "there is no such file.*presage train .*exact", {}),
        ({"drive": "sideways"}, "drive: .*'differential'.*--drive", {}),
        ({}, "radius: .*finite.*PRESAGE_RADIUS", {"RADIUS": "nan"}),
        ({}, r"start \(3.00, 1.50\) in corridor is 1.50 m from a wall, .* needs 2 m", {"RADIUS": "2"}),
        ({}, "100 s to stop", {"ACCELERATION": "0.01"}),
        ({}, "start .* in corridor is inside something", {"START": "100,1"}),
        ({}, "pace: .*PRESAGE_PACE", {"PACE": "quick"}),
        ({"simulator": ["--scanner", "sonar"]}, "no scanner 'sonar'", {}),
        ({"world": "nowhere"}, "no world 'nowhere'", {}),
        (
            {"world": "maze", "estimator": ["--estimator=paper"]},
            "presage train --world maze .*--model exact",
            {},
        ),
        (
            {"estimator": ["--estimator=paper"], "drive": "differential"},
            "set drive to holonomic, or choose another estimator",
            {},
        ),
    ],
)
def test_mistakes_are_one_line(wrong, says, variables, monkeypatch):
    if "--estimator=paper" in wrong.get("estimator", ()):
        pytest.importorskip("torch")
    for name, value in variables.items():
        monkeypatch.setenv(f"PRESAGE_{name}", value)
    with pytest.raises(UserError, match=says) as error:
        plan(**wrong)
    assert "\n" not in str(error.value)


def test_a_world_without_a_model(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(save_world(load_world("corridor").model_copy(update={"name": "mine"})))
    with pytest.raises(UserError, match=r"presage train --world .*mine\.yaml .*--model exact"):
        plan(str(path))
    plan(str(path), estimator=["--model", "exact"])
    planned = plan(str(path), mapping=True)
    assert "--world=" in planned.controller
    assert "--hide-world" in planned.simulator
