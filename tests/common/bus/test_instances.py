"""Several processes of one service: names, who leads, who is heard."""

from __future__ import annotations

import hypothesis.strategies as st
from hypothesis import given

from common.bus.instances import Instance, Instances, SourceSelector, describe_instance

names = st.builds(
    Instance, st.integers(0, 2**48 - 1), st.text(min_size=1, max_size=80), st.integers(1, 2**22),
    st.text("0123456789abcdef", max_size=32),
)  # fmt: skip


@given(names)
def test_a_name_is_one_chunk_of_a_key_and_can_be_read_again(instance):
    name = instance.name
    assert not set(name) & set("/*$#?@")
    again = Instance.parse(name)
    assert again is not None
    assert again.name == name
    assert (again.started_ms, again.pid) == (instance.started_ms, instance.pid)
    assert f"process {instance.pid} on " in describe_instance(name)


@given(names, names)
def test_names_in_order_are_instances_by_age(one, other):
    assert one.started_ms == other.started_ms or (one.name < other.name) == (one.started_ms < other.started_ms)


def test_what_is_no_name_is_said_as_it_is():
    assert Instance.parse("estimator") is None
    assert describe_instance("estimator") == "estimator"


EVERYBODY = [Instance(k, "host", 1, f"{k}").name for k in range(5)]


@given(st.lists(st.tuples(st.sampled_from(EVERYBODY), st.booleans(), st.booleans()), max_size=30))
def test_of_all_who_see_the_same_at_most_one_takes_the_lead(events):
    """What each of them sees: everything but itself; those that may lead when nobody does are one."""
    everybody = {name: Instances(name) for name in EVERYBODY}
    leading, waiting = set(), set()
    for name, leads, there in events:
        group = leading if leads else waiting
        (group.add if there else group.discard)(name)
        for instances in everybody.values():
            instances.update(name, leads=leads, alive=there)
    candidates = [name for name in waiting - leading if everybody[name].may_lead()]
    assert len(candidates) == (0 if leading or not waiting else 1)
    stay = [name for name in leading if not everybody[name].must_yield()]
    assert stay == ([min(leading)] if leading else [])


@given(names, names)
def test_what_this_session_said_before_is_nobody_else(me, other):
    """Zenoh may tell a session of a token of its own that is gone: a robot that came back was never served again."""
    instances = Instances(me.name)
    instances.update(Instance(other.started_ms, me.host, me.pid, me.zid).name, leads=True, alive=True)
    assert instances.may_lead()
    assert not instances.must_yield()
    instances.update(Instance(other.started_ms, me.host, me.pid + 1, me.zid).name, leads=True, alive=True)
    assert not instances.may_lead()


def test_where_nobody_leads_the_first_source_is_heard_until_it_is_silent():
    sources = SourceSelector(0.3)

    def takes(source, now, robot="robot"):
        return sources.accepts(f"presage/{robot}/scan", "simulator", source, now)

    assert takes("a", 0.0)
    assert not takes("b", 0.1)
    assert takes("b", 0.1, "other")
    assert takes("a", 0.3)
    assert not takes("b", 0.55)  # what was refused does not count as heard
    assert takes("b", 0.6)
    assert not takes("a", 0.7)


def test_the_instance_that_leads_is_heard_and_nobody_else_however_silent_it_is():
    sources = SourceSelector(0.3)
    leader = Instance(1, "host", 2, "0123456789ab")
    sources.update("robot", "simulator", leader.name, True)
    assert not sources.accepts("presage/robot/scan", "simulator", "repeater", 0.0)
    assert sources.accepts("presage/robot/scan", "simulator", "0123456789abcdef", 5.0)
    assert not sources.accepts("presage/robot/scan", "simulator", "repeater", 50.0)
    assert sources.accepts("presage/robot/belief", "estimator", "anybody", 50.0)  # nobody leads there
    younger = Instance(2, "host", 1, "ba9876543210")
    sources.update("robot", "simulator", younger.name, True)  # two halves of a network have met
    assert not sources.accepts("presage/robot/scan", "simulator", "ba9876543210", 50.0)
    sources.update("robot", "simulator", younger.name, False)
    sources.update("robot", "simulator", leader.name, False)
    assert sources.accepts("presage/robot/scan", "simulator", "repeater", 50.0)
