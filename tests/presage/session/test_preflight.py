"""What `presage up` finds wrong before it starts anything."""

from __future__ import annotations

import pytest

from common.errors import UserError
from common.geometry.world import load_world, save_world
from presage.session.preflight import check_services
from presage.session.stack import controller_arguments


def check(world="corridor", *, estimator=(), limits=("--drive", "holonomic"), simulator=()):
    asked = ["--world", world]
    driving = controller_arguments(world, estimator, limits)
    check_services(world, [*asked, *estimator], driving, None if simulator is None else [*asked, *limits, *simulator])


def test_what_is_shipped_is_fine():
    check()
    check(simulator=["--start", "3,1.5,90"])
    check(estimator=["--estimator", "particle-filter"], limits=["--drive=differential", "--radius=0.105"])
    check("maze", estimator=["--model", "exact"], simulator=None)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"estimator": ["--estimator", "presice"]}, "estimator: .*'precise'.*--estimator"),
        ({"estimator": ["--model", "exakt"]}, "no model 'exakt': give learned, exact"),
        ({"estimator": ["--model", "no.safetensors"]}, "no.safetensors: there is no such file.*presage train .*exact"),
        ({"estimator": ["--prior", "hunch"]}, "prior: .*--prior"),
        ({"limits": ["--drive", "sideways"]}, "drive: .*'differential'.*--drive"),
        ({"limits": ["--radius", "nan"]}, "radius: .*finite.*--radius"),
        ({"limits": ["--radius", "2"]}, r"start \(3.00, 1.50\) is 1.50 m from a wall .* needs 2 m"),
        ({"limits": ["--acceleration", "0.01"]}, "100 s to stop"),
        ({"simulator": ["--start", "1;2"]}, "start: '1;2' .*--start"),
        ({"simulator": ["--start", "100,1"]}, "start .* is inside a wall or outside 'corridor'.*--start"),
        ({"simulator": ["--pace", "quick"]}, "pace: .*--pace"),
        ({"simulator": ["--scanner", "sonar"]}, "no scanner 'sonar'"),
        ({"world": "nowhere"}, "no world 'nowhere'"),
        ({"world": "maze", "estimator": ["--estimator", "paper"]}, "presage train --world maze .*--model exact"),
        (
            {"estimator": ["--estimator", "paper"], "limits": ["--drive", "differential"]},
            "preset paper moves without turning",
        ),
    ],
)
def test_what_is_wrong_is_one_line(wrong, says):
    world = wrong.pop("world", "corridor")
    with pytest.raises(UserError, match=says):
        check(world, **wrong)


def test_a_world_without_a_model_is_told_both_ways(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(save_world(load_world("corridor").model_copy(update={"name": "mine"})))
    with pytest.raises(UserError, match=r"presage train --world .*mine\.yaml .*--model exact"):
        check(str(path))
    check(str(path), estimator=["--model", "exact"])
    check(str(path), estimator=["--estimator", "particle-filter"])
