"""Fault injection into a driving system with `presage bench chaos`.

These tests only assert that the system stops and recovers. The times, which depend on the machine's load, are measured
by `make chaos`, which injects all faults.
"""

from __future__ import annotations

import json

import pytest

from lab.fault_injection.faults import FAULTS
from tests.conftest import Processes

ROWS = (
    "killed: estimator", "killed: controller", "killed: router", "killed: recorder", "frozen 1 s: controller",
    "network cut 1 s", "duplicates, late", "malformed",
)  # fmt: skip


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    """Results of all faults, injected into one system."""
    folder = tmp_path_factory.mktemp("chaos")
    processes, file = Processes(folder), folder / "chaos.json"
    try:
        running = processes.start("presage.__main__", "bench", "chaos", *ROWS, "--json", str(file))
        running.wait(170)
        assert file.exists(), running.output
        return json.loads(file.read_text())
    finally:
        processes.close()


def test_the_tested_faults_exist():
    assert set(ROWS) <= {fault.name for fault in FAULTS}
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("name", ROWS)
def test_the_robot_stops_if_expected_and_recovers(outcomes, name):
    if name in outcomes["skipped"]:
        pytest.skip(f"NOT TRIED: {outcomes['skipped'][name]}")
    (row,) = [row for row in outcomes["rows"] if row["fault"] == name]
    assert not row["contact"], row
    if row["expect"] == "stops":
        assert row["stopped_s"] is not None, row
        assert row["detected_s"] is not None, row
    if row["expect"] != "goes on" or row["start_s"] is not None:
        assert row["again_s"] is not None, row
