"""Settings of the bridge, and messages for invalid ones."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import UserError
from common.runtime.config import load_settings
from services.bridge_ros2.settings import BridgeRos2Settings


@pytest.mark.parametrize(
    ("given", "pose"), [("0.1,-2", (0.1, -2, 0)), ("0.1,0,180", (0.1, 0, np.pi)), ("-1,0,-90", None)]
)
def test_mount(given, pose):
    mount = load_settings(BridgeRos2Settings, ["--mount", given]).build_mount()
    np.testing.assert_allclose(mount.pose, pose or (-1, 0, -np.pi / 2))


@pytest.mark.parametrize("given", ["1", "1;2", "1,2,3,4", "a,b"])
def test_invalid_mount(given):
    with pytest.raises(UserError, match=r"mount: '.*' is not valid; expected: x,y\[,yaw_deg\] \(m, m, degrees\)"):
        load_settings(BridgeRos2Settings, ["--mount", given])


@pytest.mark.parametrize("given", ["nonsense", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", "tcp/127.0.0.1:0", "tcp/a:1,b"])
def test_router_without_a_port(given):
    with pytest.raises(UserError, match="ros_connect"):
        load_settings(BridgeRos2Settings, ["--ros-connect", given])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["--odom-frame", "map"], "three frames, each needs a name of its own"),
        (["--base-frame", "odom"], "--odom-frame odom, --base-frame odom"),
        (["--scan-topic", "odom"], "a topic has one type"),
        (["--ros-config", "no/such.json5"], "there is no such file"),
    ],
)
def test_contradictions(given, says):
    settings = load_settings(BridgeRos2Settings, given)
    with pytest.raises(UserError, match=says):
        settings.check()
