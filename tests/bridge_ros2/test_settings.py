"""What the bridge is told."""

from __future__ import annotations

import numpy as np
import pytest

from common.config import load_settings
from common.errors import UserError
from services.bridge_ros2.settings import BridgeRos2Settings


@pytest.mark.parametrize(
    ("said", "pose"), [("0.1,-2", (0.1, -2, 0)), ("0.1,0,180", (0.1, 0, np.pi)), ("-1,0,-90", None)]
)
def test_a_mount_with_or_without_its_yaw(said, pose):
    mount = load_settings(BridgeRos2Settings, ["--mount", said]).the_mount()
    np.testing.assert_allclose(mount.pose, pose or (-1, 0, -np.pi / 2))


@pytest.mark.parametrize("said", ["1", "1;2", "1,2,3,4", "a,b"])
def test_a_wrong_mount_says_what_is_expected(said):
    with pytest.raises(UserError, match=r"mount: '.*' is not as it should be: x,y\[,yaw_deg\] \(m, m, degrees\)"):
        load_settings(BridgeRos2Settings, ["--mount", said])
