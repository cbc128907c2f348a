"""Files that are written completely or not at all."""

from __future__ import annotations

import pytest

from common.writing import complete_files, name_in_errors

FULL = OSError(28, "No space left on device")


def content(folder):
    return {file.name: file.read_text() for file in folder.iterdir()}


def test_complete_files(tmp_path):
    (tmp_path / "a.csv").write_text("old")
    with complete_files(tmp_path / "a.csv") as partial:
        (partial / "a.csv").write_text("new")
        (partial / "a.json").write_text("new")
        assert (tmp_path / "a.csv").read_text() == "old"
    assert content(tmp_path) == {"a.csv": "new", "a.json": "new"}


@pytest.mark.parametrize("failure", [FULL, KeyboardInterrupt()])
def test_failures_leave_the_old_files(tmp_path, failure):
    path = tmp_path / "a.csv"
    path.write_text("old")

    def write():
        with complete_files(path) as partial:
            (partial / "a.csv").write_text("new")
            raise failure

    with pytest.raises(type(failure)) as error:
        write()
    assert content(tmp_path) == {"a.csv": "old"}
    assert getattr(error.value, "filename", str(path)) == str(path)


def test_errors_name_the_file(tmp_path):
    path = tmp_path / "a.csv"
    with pytest.raises(IsADirectoryError) as error, complete_files(path) as partial:
        partial.write_text("")
    assert error.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as error, complete_files(path):
        (tmp_path / "b.csv").read_bytes()
    assert error.value.filename == str(tmp_path / "b.csv")
    with pytest.raises(OSError, match="No space left") as error, name_in_errors(path):
        raise FULL
    assert error.value.filename == str(path)
