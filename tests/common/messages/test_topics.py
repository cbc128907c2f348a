"""Consistency of the table of topics."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.messages.topics import QUERIES, ROBOT_NAME_PATTERN, ROOT, TOPICS, alive_key, topic_of
from common.runtime.config import ServiceSettings

ROBOTS = st.from_regex(ROBOT_NAME_PATTERN, fullmatch=True)  # what the settings let through
CHUNK = re.compile(r"[A-Za-z0-9_.-]+")


def test_names_and_keys_are_unique():
    rows = [*TOPICS, *QUERIES]
    assert len({row.name for row in rows}) == len(rows)
    assert len({row.key("robot", "simulator") for row in rows} | {alive_key("robot", "simulator")}) == len(rows) + 1


@pytest.mark.parametrize("row", [*TOPICS, *QUERIES], ids=lambda row: row.name)
def test_rows_are_complete(row):
    assert CHUNK.fullmatch(row.name)
    assert row.name == row.name.lower()
    assert row.about
    assert not hasattr(row, "rate") or 0 <= row.rate <= 1000
    assert row.key("r2", "x").split("/")[:3] == [ROOT, "r2", row.name]
    assert ("*" in row.key("r2")) == row.per_service


@given(ROBOTS, st.sampled_from(TOPICS))
def test_topic_of_is_the_inverse_of_key(robot, topic):
    key = topic.key(robot, "simulator")
    assert all(CHUNK.fullmatch(chunk) for chunk in key.split("/"))
    assert topic_of(key) is topic


@given(ROBOTS, st.sampled_from(TOPICS))
def test_similar_keys_belong_to_no_topic(robot, topic):
    key = topic.key(robot, "simulator")
    for other in (key + "/more", "other" + key, key.rsplit("/", 1)[0], key + "x", "/" + key, ""):
        assert topic_of(other) in (None, *(t for t in TOPICS if t.per_service and other == key + "x"))


def test_robot_names_are_valid_in_keys():
    pattern = next(m.pattern for m in ServiceSettings.model_fields["robot"].metadata if getattr(m, "pattern", None))
    for bad in ("", "a/b", "*", "**", "a b", "@x", "$*", "x" * 65, "a#b", "a?b"):
        assert not re.search(pattern, bad), bad
    assert re.search(pattern, "pmb2-7.lab_A")


def test_queue_policies():
    policy = {topic.name: topic.queue for topic in TOPICS}
    assert policy["cmd_vel"] == policy["scan"] == policy["belief"] == "newest"
    assert policy["health"] == "all"
