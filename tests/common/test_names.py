"""Comma-separated names."""

from __future__ import annotations

from common.names import split_names


def test_split_names():
    assert split_names(" tcp/a:1, tcp/b:2,, ") == ["tcp/a:1", "tcp/b:2"]
    assert split_names("") == []
