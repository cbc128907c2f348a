"""`presage bench chaos`: the robot stops at a fault and drives on afterwards.

The times, which depend on the machine's load, are measured by `make chaos`, which injects all faults. Killed services,
a frozen controller and malformed payloads have tests of their own in this folder.
"""

from __future__ import annotations

import json

import pytest

from lab.fault_injection.faults import FAULTS

ROWS = ("killed: router", "killed: recorder", "network cut 1 s", "duplicates, late")
LATE = ("only after more than", "stood after more than")  # on a busy machine


def reasons(row):
    """Why the benchmark says that the system did not react to a fault as expected."""
    # A robot that should go on may brake on a busy machine, because a command is late; see `driving_share`.
    return {*row["why"].split("; ")} - {"", "the robot did not go on"}


def test_faults(process, tmp_path):
    names = {fault.name for fault in FAULTS}
    assert len(names) == len(FAULTS)
    assert names >= set(ROWS)
    file = tmp_path / "chaos.json"
    running = process("presage.__main__", "bench", "chaos", *ROWS, "--json", str(file))
    status = running.wait(170)
    assert file.exists(), running.output
    found = json.loads(file.read_text())
    assert status == any(row["why"] for row in found["rows"]), running.output
    for row in found["rows"]:
        assert all(any(late in why for late in LATE) for why in reasons(row)), row
        assert not row["contact"], row
        if row["expect"] == "stops":
            assert row["stopped_s"] is not None, row
            assert row["detected_s"] is not None, row
        if row["expect"] == "goes on":
            assert row["driving_share"] > 0.5, row
        if row["expect"] != "goes on" or row["start_s"] is not None:
            assert row["again_s"] is not None, row
    assert {row["fault"] for row in found["rows"]} | found["skipped"].keys() == set(ROWS)
    if found["skipped"]:
        pytest.skip(f"NOT TRIED: {found['skipped']}")
