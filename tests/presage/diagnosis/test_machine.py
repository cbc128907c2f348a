"""Checks of folders on this machine."""

from __future__ import annotations

import pytest

from presage.diagnosis import machine


@pytest.mark.parametrize("unwritable", [{"estimator"}, {"controller"}, {"estimator", "controller"}])
def test_unwritable_caches_of_compiled_code(unwritable, tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(machine, "find_write_error", lambda path: "read-only" if path.name in unwritable else "")
    (problem,) = [each for each in machine.check_machine(tmp_path) if each.ok is None]
    assert "compiled code cannot be cached in" in problem.what
    assert problem.advice.startswith("services compile their code again at each start")
