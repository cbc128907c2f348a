"""`presage replay FILE --with estimator`: from the file alone, what a lockstep session believed, to the last bit."""

from __future__ import annotations

import json

from tests.system.test_loop import SCANS, run_in_lockstep


def again(process, tmp_path, recording, *more, env=None):
    """Status, output and the numbers of a replay with services."""
    numbers = tmp_path / "again.json"
    done = process("presage.__main__", "replay", str(recording), *more, "--json", str(numbers), env=env)
    status = done.wait(150)
    return status, done.output, json.loads(numbers.read_text()) if numbers.exists() else {}


def test_a_lockstep_session_is_believed_again_to_the_last_bit(process, bus, tmp_path):
    run_in_lockstep(process, bus, tmp_path, "run")
    # What the environment says is not what was recorded.
    status, said, numbers = again(
        process, tmp_path, tmp_path / "run.mcap", "--with", "estimator,controller", env={"PRESAGE_SIGMA": "0.5"}
    )
    assert status == 0, said
    beliefs, commands = numbers["beliefs"], numbers["commands"]
    assert numbers["lockstep"]
    assert numbers["good"]
    assert beliefs["equal"] == beliefs["compared"] >= SCANS
    assert beliefs["position_difference_max_m"] == 0.0
    assert beliefs["recorded_without_new"] == 0
    assert commands["equal"] == commands["compared"] >= SCANS
    assert "this is what it believed" in said
