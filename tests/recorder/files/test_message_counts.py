"""Counts of gaps, missing messages and restarts."""

from __future__ import annotations

import itertools

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.messages.definitions import Goal, Health, Pose, TopicHealth, Truth, Twist
from services.recorder.files.message_counts import (
    MAX_INSTANCES,
    MAX_REORDER_DISTANCE,
    Count,
    Ledger,
    Sequence,
    as_metadata,
    from_metadata,
    sequence_of,
)

SCAN, GOAL = "presage/r/scan", "presage/r/goal"


def seen(*numbers):
    sequence = Sequence()
    for number in numbers:
        sequence.see(number)
    return sequence.gaps, sequence.missing, sequence.restarts, sequence.reordered


@pytest.mark.parametrize(
    ("numbers", "counted"),
    [
        ((0, 1, 2), (0, 0, 0, 0)),
        ((), (0, 0, 0, 0)),
        ((700, 701), (0, 0, 0, 0)),  # the recorder started later
        ((0, 1, 4, 5, 7), (2, 3, 0, 0)),
        ((0, 1, 2, 0, 1), (0, 0, 1, 0)),  # restarted
        ((998, 999, 3, 4), (0, 0, 1, 0)),  # restarted, and its first messages were lost
        ((10, 11, 11, 10, 12), (0, 0, 0, 2)),
        ((10, 12, 11, 13), (1, 1, 0, 1)),
    ],
)
def test_what_a_publishers_numbers_say(numbers, counted):
    assert seen(*numbers) == counted


@given(st.sets(st.integers(0, 500), min_size=1))
def test_missing_is_what_was_left_out(numbers):
    ordered = sorted(numbers)
    gaps, missing, restarts, reordered = seen(*ordered)
    assert missing == ordered[-1] - ordered[0] + 1 - len(ordered)
    assert gaps == sum(b - a > 1 for a, b in itertools.pairwise(ordered))
    assert (restarts, reordered) == (0, 0)


@given(st.integers(1, 10_000), st.integers(0, MAX_REORDER_DISTANCE - 1))
def test_no_number_is_both(last, back):
    gaps, missing, restarts, reordered = seen(last, max(0, last - back))
    assert (gaps, missing) == (0, 0)
    assert restarts + reordered == 1


def truth(number):
    return Truth(stamp_ns=0, seq=number, pose=Pose(x=0.0, y=0.0), twist=Twist()).encode()


def test_the_ledger_counts_by_key_and_a_goals_numbers_are_none():
    ledger = Ledger()
    for number in (0, 1, 5):
        ledger.see("presage/r/truth", truth(number))
    ledger.see("presage/r/truth", b"\xc1")
    for number in (10**18, 5):
        ledger.see(GOAL, Goal(stamp_ns=0, seq=number, pose=Pose(x=0.0, y=0.0)).encode())
    counts = ledger.counts({"presage/r/truth": 6, SCAN: 2}, {SCAN: 1}, {SCAN: 1})
    assert counts["presage/r/truth"] == Count(received=6, written=4, unreadable=1, gaps=1, missing=3)
    assert counts[GOAL] == Count(written=2)
    assert counts[SCAN] == Count(received=2, dropped=1, oversized=1)
    assert from_metadata(as_metadata(counts)) == counts


def test_two_instances_of_a_service_are_counted_apart():
    ledger, key = Ledger(), "presage/r/health/recorder"
    for first, second in enumerate([0, 1, 2, 4]):
        for name, number in (("a", 100 + first), ("b", second)):
            ledger.see(key, Health(stamp_ns=0, seq=number, service="recorder", uptime=1, instance=name).encode())
    lost = ledger.lost(key)
    assert (lost.gaps, lost.missing, lost.restarts, lost.reordered) == (1, 1, 0, 0)


def test_invented_instances_do_not_fill_memory():
    ledger = Ledger()
    for number in range(3 * MAX_INSTANCES):
        ledger.see(SCAN, msgpack.packb({"seq": 0, "instance": str(number)}))
    assert len(ledger.sequences[SCAN]) == MAX_INSTANCES + 1


def test_what_is_no_count_is_left_out():
    assert from_metadata({"a": "no JSON", "b": '{"strange": 1}', "c": '{"written": 3}'}) == {"c": Count(written=3)}


@given(st.binary(max_size=100))
def test_any_payload_may_come(payload):
    numbered = sequence_of(payload)
    assert numbered is None or numbered[0] >= 0


@pytest.mark.parametrize("numbers", [[0, 2**63 - 1], [0, 2**64 - 1, 5], [0, 2**62, 0, 2**62, 0, 2**62, 0, 2**62]])
def test_numbers_somebody_made_up_still_make_a_count_that_health_can_hold(numbers):
    ledger = Ledger()
    for number in numbers:
        ledger.see(SCAN, msgpack.packb({"seq": number}))
    missing = ledger.lost(SCAN).missing
    assert TopicHealth(key="k", missing=missing).missing == missing
    assert missing > 0
