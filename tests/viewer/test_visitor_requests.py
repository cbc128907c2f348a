"""A message from a browser is an action, or is refused with a reason."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.viewer import visitor_requests as requests

BOX = {"box": {"center": [1, 2], "size": [1, 0.5], "yaw_deg": 30}}
GOOD = [
    ({"do": "watch", "robot": "robot-2"}, requests.WatchRobot(do="watch", robot="robot-2")),
    ({"do": "goal", "x": 1, "y": 2.5}, requests.GoTo(do="goal", x=1.0, y=2.5)),
    ({"do": "goal", "x": 1, "y": 2, "yaw": -1.5, "tolerance": 0.1}, requests.GoTo(do="goal", x=1, y=2, yaw=-1.5, tolerance=0.1)),  # noqa: E501
    ({"do": "cancel"}, requests.CancelGoal(do="cancel")),
    ({"do": "teleport", "x": 1, "y": 2, "yaw": 3}, requests.Teleport(do="teleport", x=1, y=2, yaw=3)),
    ({"do": "localise"}, requests.Localise(do="localise")),
    ({"do": "localise", "x": 1, "y": 2, "yaw": None}, requests.Localise(do="localise", x=1, y=2)),
    ({"do": "obstacle", "action": "remove", "name": "crate"},
     requests.EditObstacle(do="obstacle", action="remove", name="crate")),
    ({"do": "pause"}, requests.ControlClock(do="pause")),
    ({"do": "step"}, requests.ControlClock(do="step")),
    ({"do": "reset", "seed": 7}, requests.ResetSimulation(do="reset", seed=7)),
    ({"do": "speed", "factor": 2}, requests.SetSpeed(do="speed", factor=2)),
    ({"do": "drive", "vx": 0.5, "vy": 0, "wz": -1}, requests.DriveByHand(do="drive", vx=0.5, vy=0, wz=-1)),
    ({"do": "record", "action": "start"}, requests.ControlRecorder(do="record", action="start")),
    ({"do": "save_map", "name": "here"}, requests.SaveMap(do="save_map", name="here")),
    ({"do": "recordings"}, requests.ListRecordings(do="recordings")),
    ({"do": "open", "name": "run.mcap"}, requests.OpenRecordingFile(do="open", name="run.mcap")),
    ({"do": "close"}, requests.CloseRecordingFile(do="close")),
    ({"do": "player", "action": "seek", "value": 3.5}, requests.ControlPlayer(do="player", action="seek", value=3.5)),
]  # fmt: skip


@pytest.mark.parametrize(("message", "action"), GOOD)
def test_actions(message, action):
    assert requests.parse(json.dumps({"id": 5, **message, "later": "field"})) == (5, action)


def test_obstacle():
    _, action = requests.parse(
        json.dumps({"id": 1, "do": "obstacle", "action": "add", "name": "crate", "obstacle": BOX})
    )
    assert action.obstacle.box.center == (1.0, 2.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not valid JSON"),
        ("{", "not valid JSON"),
        ("[" * 4000, "not valid JSON"),
        ("9" * 4090, ""),
        ("[]", "a JSON object"),
        ("null", "a JSON object"),
        ("{}", "unknown action; the actions are: watch, goal"),
        ('{"do": ["goal"]}', "unknown action"),
        ('{"do": "explode"}', "unknown action"),
        ('{"do": "goal", "x": 1}', "y: missing"),
        ('{"do": "goal", "x": "1", "y": 2}', "x: "),
        ('{"do": "goal", "x": true, "y": 2}', "x: "),
        ('{"do": "goal", "x": NaN, "y": 2}', "x: "),
        ('{"do": "goal", "x": 1e999, "y": 2}', "x: "),
        ('{"do": "goal", "x": 1' + "0" * 400 + ', "y": 2}', ""),
        ('{"do": "goal", "x": 1, "y": 2, "tolerance": 0}', "tolerance: "),
        ('{"do": "watch", "robot": "a/../b"}', "robot: "),
        ('{"do": "watch", "robot": "*"}', "robot: "),
        ('{"do": "obstacle", "action": "add", "name": "x", "obstacle": {}}', "exactly one of"),
        (
            '{"do": "obstacle", "action": "add", "name": "x", "obstacle": {"polygon": [[0,0],[1,1],[1,0],[0,1]]}}',
            "not simple",
        ),
        ('{"do": "drive", "vx": 1e9}', "vx: "),
        ('{"do": "player", "action": "eject"}', "action: "),
        ('{"do": "goal", "x": 1, "y": 2, "pad": "' + "x" * 4096 + '"}', "too long"),
    ],
)
def test_refusals(text, says):
    with pytest.raises(requests.InvalidRequestError) as refused:
        requests.parse(text)
    assert says in str(refused.value)
    assert str(refused.value)


@pytest.mark.parametrize("number", [3, None])
def test_number_of_a_refusal(number):
    with pytest.raises(requests.InvalidRequestError) as refused:
        requests.parse(json.dumps({"id": number, "do": "goal"}))
    assert refused.value.number == number


@pytest.mark.parametrize("number", ["5", 1.5, True, [1], {"a": 1}, 2**60])
def test_invalid_numbers(number):
    assert requests.parse(json.dumps({"id": number, "do": "cancel"}))[0] is None


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
FIELDS = ["id", "x", "y", "yaw", "robot", "action", "name", "obstacle", "value", "seed", "factor", "tolerance", "vx"]
SHAPES = st.fixed_dictionaries({}, optional=dict.fromkeys(("box", "circle", "polygon", "name"), VALUES))


@given(
    st.text(max_size=200)
    | VALUES.map(json.dumps)
    | st.builds(
        lambda do, fields, obstacle: json.dumps({"do": do, **fields, "obstacle": obstacle}),
        st.sampled_from([message["do"] for message, _ in GOOD]),
        st.dictionaries(st.sampled_from(FIELDS), VALUES),
        VALUES | SHAPES,
    )
)
def test_any_text(text):
    try:
        number, action = requests.parse(text)
    except requests.InvalidRequestError as refused:
        reason, number, action = str(refused), refused.number, None
    else:
        reason = ""
    assert bool(reason) != isinstance(action, requests.Action)
    assert number is None or isinstance(number, int)
