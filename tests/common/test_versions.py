"""What made a result."""

from __future__ import annotations

import shlex

from common.versions import presage_command


def test_command_can_be_pasted_into_a_shell(monkeypatch):
    arguments = ["train", "--world", "my maps/hall.yaml", "--pose", "-1,2"]
    monkeypatch.setattr("sys.argv", ["/bin/presage", *arguments])
    assert shlex.split(presage_command()) == ["presage", *arguments]
