"""Several instances of a service: names, leader election and source selection."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import given

from common.bus.instances import Instance, Instances, SourceSelector, describe_instance

names = st.builds(
    Instance, st.integers(0, 2**48 - 1), st.text(min_size=1, max_size=80), st.integers(1, 2**22),
    st.text("0123456789abcdef", min_size=1, max_size=32),
)  # fmt: skip


@given(names)
def test_names_as_key_chunks(instance):
    name = instance.name
    assert not set(name) & set("/*$#?@")
    again = Instance.parse(name)
    assert again is not None
    assert again.name == name
    assert (again.started_ms, again.pid) == (instance.started_ms, instance.pid)
    assert f"process {instance.pid} on " in describe_instance(name)


@given(names, names)
def test_names_sort_by_age(one, other):
    assert one.started_ms == other.started_ms or (one.name < other.name) == (one.started_ms < other.started_ms)


def test_other_names_are_returned_unchanged():
    assert Instance.parse("estimator") is None
    assert describe_instance("estimator") == "estimator"


NAMES = [Instance(k, "host", 1, f"{k}").name for k in range(5)]


@given(st.lists(st.tuples(st.sampled_from(NAMES), st.booleans(), st.booleans()), max_size=30))
def test_one_leader(events):
    """Each instance sees all others; if none leads, exactly one of them may lead."""
    instances_of = {name: Instances(name) for name in NAMES}
    leading, waiting = set(), set()
    for name, leads, alive in events:
        group = leading if leads else waiting
        (group.add if alive else group.discard)(name)
        for instances in instances_of.values():
            instances.update(name, leads=leads, alive=alive)
    candidates = [name for name in waiting - leading if instances_of[name].may_lead()]
    assert len(candidates) == (0 if leading or not waiting else 1)
    stay = [name for name in leading if not instances_of[name].must_yield()]
    assert stay == ([min(leading)] if leading else [])


@given(names, names)
def test_own_earlier_tokens(me, other):
    """Zenoh may report an earlier token of the session itself, which must not prevent it from leading again."""
    instances = Instances(me.name)
    instances.update(Instance(other.started_ms, me.host, me.pid, me.zid).name, leads=True, alive=True)
    assert instances.may_lead()
    assert not instances.must_yield()
    instances.update(Instance(other.started_ms, me.host, me.pid + 1, me.zid).name, leads=True, alive=True)
    assert not instances.may_lead()


def test_source_without_a_leader():
    sources = SourceSelector(0.3)

    def takes(source, now, robot="robot"):
        return sources.accepts(f"presage/{robot}/scan", "simulator", source, now)

    assert takes("a", 0.0)
    assert not takes("b", 0.1)
    assert takes("b", 0.1, "other")
    assert takes("a", 0.3)
    assert not takes("b", 0.55)  # a rejected message does not select its source
    assert takes("b", 0.6)
    assert not takes("a", 0.7)


def test_silent_leader():
    sources = SourceSelector(0.3)
    leader = Instance(1, "host", 2, "0123456789ab")
    sources.update("robot", "simulator", leader.name, True)
    assert not sources.accepts("presage/robot/scan", "simulator", "repeater", 0.0)
    assert sources.accepts("presage/robot/scan", "simulator", "0123456789abcdef", 5.0)
    assert not sources.accepts("presage/robot/scan", "simulator", "repeater", 50.0)
    assert sources.accepts("presage/robot/belief", "estimator", "other", 50.0)  # the estimator has no leader
    younger = Instance(2, "host", 1, "ba9876543210")
    sources.update("robot", "simulator", younger.name, True)  # two parts of a network were joined
    assert not sources.accepts("presage/robot/scan", "simulator", "ba9876543210", 50.0)
    sources.update("robot", "simulator", younger.name, False)
    sources.update("robot", "simulator", leader.name, False)
    assert sources.accepts("presage/robot/scan", "simulator", "repeater", 50.0)
