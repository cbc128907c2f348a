"""Whether something can be written is known before the run."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from common.errors import UserError
from presage.terminal.output import check_file, make_folder, write_json


def test_what_can_be_written_leaves_no_trace(tmp_path):
    (tmp_path / "old").write_text("old")
    check_file(tmp_path / "new.json", "--json")
    check_file(tmp_path / "old", "--json")
    check_file(Path("/dev/null"), "--json")
    check_file(None, "--json")
    make_folder(tmp_path / "a" / "b", "--out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "old"]
    assert (tmp_path / "old").read_text() == "old"
    assert not list((tmp_path / "a" / "b").iterdir())


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    check_file(tmp_path / "pipe", "--json")


@pytest.mark.parametrize("name", ["missing/x.json", "file/x.json", "."])
def test_a_file_that_cannot_be_is_one_line(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot be written to .* choose another file with --json") as error:
        check_file(tmp_path / name, "--json")
    assert str(tmp_path / name) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("folder", ["/dev/null", "/dev/null/x", "/proc/nowhere"])
def test_a_folder_that_cannot_be_is_one_line(folder):
    with pytest.raises(UserError, match=f"{folder}: cannot be written to .* choose another folder with --out"):
        make_folder(Path(folder), "--out")


def test_numbers_are_written_where_asked_for(tmp_path):
    write_json(None, {})
    write_json(tmp_path / "x.json", {"update_ms": 1.5})
    assert json.loads((tmp_path / "x.json").read_text()) == {"update_ms": 1.5}
