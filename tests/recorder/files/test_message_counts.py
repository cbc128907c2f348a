"""Counts of gaps, missing messages and restarts."""

from __future__ import annotations

import itertools

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.geometry.occupancy_grid import OccupancyGrid
from common.messages.definitions import Goal, Health, Map, Pose, TopicHealth, Truth, Twist
from services.recorder.files.message_counts import (
    MAX_INSTANCES,
    KeyCounts,
    MessageCounts,
    SequenceNumbers,
    as_metadata,
    from_metadata,
    sequence_of,
)

SCAN, GOAL, TRUTH, MAP = "presage/r/scan", "presage/r/goal", "presage/r/truth", "presage/r/map"
GRID = OccupancyGrid.of(np.zeros((2, 2), np.uint8), 0.05, (0.0, 0.0, 0.0))


def counts_of(numbers):
    sequence = SequenceNumbers()
    for number in numbers:
        sequence.add(number)
    return sequence.gaps, sequence.missing, sequence.restarts, sequence.reordered


@pytest.mark.parametrize(
    ("numbers", "counts"),  # gaps, missing, restarts, reordered
    [
        ((), (0, 0, 0, 0)),
        ((700, 701), (0, 0, 0, 0)),  # the recorder started later
        ((0, 1, 4, 5, 7), (2, 3, 0, 0)),
        ((0, 1, 2, 0, 1), (0, 0, 1, 0)),  # restarted
        ((998, 999, 3, 4), (0, 0, 1, 0)),  # restarted, and its first messages were lost
        ((10, 11, 11, 10, 12), (0, 0, 0, 2)),
        ((10, 12, 11, 13), (1, 1, 0, 1)),
    ],
)
def test_sequences(numbers, counts):
    assert counts_of(numbers) == counts


@given(st.sets(st.integers(0, 500), min_size=1))
def test_missing_numbers(numbers):
    ordered = sorted(numbers)
    gaps = sum(b - a > 1 for a, b in itertools.pairwise(ordered))
    assert counts_of(ordered) == (gaps, ordered[-1] - ordered[0] + 1 - len(ordered), 0, 0)


def test_ledger():
    message_counts = MessageCounts()
    for number in (0, 1, 5):
        message_counts.add(TRUTH, Truth(stamp_ns=0, seq=number, pose=Pose(x=0.0, y=0.0), twist=Twist()).encode())
    message_counts.add(TRUTH, b"\xc1")
    for number in (0, 3):  # a topic without a rate
        message_counts.add(MAP, Map(stamp_ns=0, seq=number, grid=GRID, poses=np.zeros((0, 3))).encode())
    for number in (10**18, 5):  # goals have several publishers, so that their numbers are not counted
        message_counts.add(GOAL, Goal(stamp_ns=0, seq=number, pose=Pose(x=0.0, y=0.0)).encode())
    counts = message_counts.counts({TRUTH: 6, SCAN: 2}, {SCAN: 1}, {SCAN: 1})
    assert counts[TRUTH] == KeyCounts(received=6, written=4, unreadable=1, gaps=1, missing=3)
    assert counts[MAP] == KeyCounts(written=2, gaps=1, missing=2)
    assert counts[GOAL] == KeyCounts(written=2)
    assert counts[SCAN] == KeyCounts(received=2, dropped=1, oversized=1)
    assert from_metadata(as_metadata(counts) | {"a": "no JSON", "b": '{"unknown": 1}'}) == counts


def test_two_instances():
    message_counts, key = MessageCounts(), "presage/r/health/recorder"
    for first, second in enumerate([0, 1, 2, 4]):
        for name, number in (("a", 100 + first), ("b", second)):
            message_counts.add(
                key, Health(stamp_ns=0, seq=number, service="recorder", uptime=1, instance=name).encode()
            )
    totals = message_counts.sequence_totals(key)
    assert (totals.gaps, totals.missing, totals.restarts, totals.reordered) == (1, 1, 0, 0)


def test_invented_instances():
    message_counts = MessageCounts()
    for number in range(3 * MAX_INSTANCES):
        message_counts.add(SCAN, msgpack.packb({"seq": 0, "instance": str(number)}))
    assert len(message_counts.sequences[SCAN]) == MAX_INSTANCES + 1


@given(st.binary(max_size=100))
def test_any_payload(payload):
    numbered = sequence_of(payload)
    assert numbered is None or numbered[0] >= 0


@pytest.mark.parametrize("numbers", [[0, 2**63 - 1], [0, 2**64 - 1, 5], [0, 2**62] * 4])
def test_forged_numbers(numbers):
    """The counts still fit into a health message."""
    message_counts = MessageCounts()
    for number in numbers:
        message_counts.add(SCAN, msgpack.packb({"seq": number}))
    assert TopicHealth(key="k", missing=message_counts.sequence_totals(SCAN).missing).missing > 0
