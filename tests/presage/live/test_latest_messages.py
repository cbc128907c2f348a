"""`session_bus`, by which commands reach a running session."""

from __future__ import annotations

import dataclasses

import pytest

from common.errors import UserError
from presage.live.latest_messages import session_bus


def test_error_for_an_unknown_robot(bus, link):
    """An error of a command for a robot that does not run becomes one that names those that do; others stay."""
    bus.declare_alive("controller")
    with pytest.raises(UserError, match="no status"), session_bus(link):
        raise UserError("no status")
    reason = f"no robot 'nobody' is running: choose .*{link.robot}"
    link_of_nobody = dataclasses.replace(link, robot="nobody")
    with pytest.raises(UserError, match=reason), session_bus(link_of_nobody):
        raise UserError("no status")
