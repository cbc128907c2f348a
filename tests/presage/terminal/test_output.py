"""Output paths are checked before the work that fills them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from common.errors import UserError
from presage.terminal.output import check_file, make_folder, output_folder


def test_checks_leave_no_trace(tmp_path):
    (tmp_path / "old").write_text("old")
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for a reader
    for file in (tmp_path / "new.json", tmp_path / "old", tmp_path / "pipe", Path("/dev/null"), None):
        check_file(file, "--json")
    make_folder(tmp_path / "a" / "b")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "old", "pipe"]
    assert (tmp_path / "old").read_text() == "old"
    assert not list((tmp_path / "a" / "b").iterdir())


def test_interruption_leaves_no_empty_folder(tmp_path):
    def interrupted(name, *files):
        with output_folder(tmp_path / name):
            for file in files:
                (tmp_path / name / file).touch()
            raise KeyboardInterrupt

    for files in ((), ("kept",)):
        with pytest.raises(KeyboardInterrupt):
            interrupted(f"{len(files)} files", *files)
    assert [path.name for path in tmp_path.iterdir()] == ["1 files"]


@pytest.mark.parametrize("name", ["missing/x.json", "file/x.json", "."])
def test_unwritable_files(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=f"{tmp_path / name}: cannot be written to .* another file with --json"):
        check_file(tmp_path / name, "--json")


@pytest.mark.parametrize("folder", ["/dev/null", "/dev/null/x", "/proc/nowhere"])
def test_unwritable_folders(folder):
    with pytest.raises(UserError, match=f"{folder}: cannot be written to .* choose another folder with --out"):
        make_folder(Path(folder))
