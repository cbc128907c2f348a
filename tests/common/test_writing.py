"""Errors while files are written."""

from __future__ import annotations

import pytest

from common.writing import writing


def test_error_names_the_file(tmp_path):
    path, partial = tmp_path / "a.csv", tmp_path / "a.csv.partial"
    partial.write_text("1")
    with pytest.raises(OSError, match="No space left") as error, writing(path, partial):
        raise OSError(28, "No space left on device")
    assert error.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


def test_other_errors_stay(tmp_path):
    with pytest.raises(FileNotFoundError) as error, writing(tmp_path / "a.csv"):
        (tmp_path / "b.csv").read_bytes()
    assert error.value.filename == str(tmp_path / "b.csv")
    partial = tmp_path / "c.csv"
    partial.touch()
    with pytest.raises(KeyboardInterrupt), writing(partial, partial):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
