"""What made a result."""

from __future__ import annotations

import functools
import shlex
import subprocess

from common import versions
from common.versions import presage_command


def test_command_can_be_pasted_into_a_shell(monkeypatch):
    arguments = ["train", "--world", "my maps/hall.yaml", "--pose", "-1,2"]
    monkeypatch.setattr("sys.argv", ["/bin/presage", *arguments])
    assert shlex.split(presage_command()) == ["presage", *arguments]


def test_states_of_a_changed_checkout(tmp_path, monkeypatch):
    def git(*arguments):
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a", *arguments], cwd=tmp_path, check=True)

    def state(text):
        (tmp_path / "code.py").write_text(text)
        versions.commit.cache_clear()
        versions.checkout_state.cache_clear()
        return versions.commit(), versions.checkout_state()

    git("init", "-q")
    (tmp_path / "code.py").write_text("one")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "result.json").write_text("1")
    git("add", ".")
    git("commit", "-q", "-m", "first")
    monkeypatch.setattr(versions, "_run", functools.partial(versions._run, cwd=tmp_path))
    monkeypatch.setattr(versions, "ROOT", tmp_path)
    try:
        committed, first, second, again = map(state, ("one", "two", "three", "two"))
        (tmp_path / "docs" / "result.json").write_text("2")
        with_result, without_changes = map(state, ("two", "one"))
    finally:
        versions.commit.cache_clear()
        versions.checkout_state.cache_clear()
    assert committed[0] == committed[1]
    assert first[0] == second[0] == committed[0] + "+"
    assert first[1] == again[1] == with_result[1] != second[1]
    assert without_changes == (committed[0] + "+", committed[1])
