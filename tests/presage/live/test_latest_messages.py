"""`session_bus`, by which commands reach a running session."""

from __future__ import annotations

import dataclasses

import pytest

from common.bus.bus import wait_until
from common.errors import UserError
from presage.live.latest_messages import session_bus
from tests.conftest import WAIT_TIMEOUT_S


def test_error_for_an_unknown_robot(bus, link):
    """An error of a command for a robot that does not run becomes one that names those that do; others stay."""
    bus.declare_alive("controller")
    assert wait_until(lambda: link.robot in bus.robots(), WAIT_TIMEOUT_S)
    with pytest.raises(UserError, match="no status"), session_bus(link):
        raise UserError("no status")
    reason = f"no robot 'other' is running: choose .*{link.robot}"
    other_link = dataclasses.replace(link, robot="other")
    with pytest.raises(UserError, match=reason), session_bus(other_link):
        raise UserError("no status")
