"""Who is there, where a query for liveliness tokens leaves some out."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import zenoh

from common.bus.liveliness import Liveliness
from common.messages.topics import alive_key


class Session:
    """A zenoh session of which queries answer ``answers``, and whose subscribers are told what a test says."""

    def __init__(self):
        self.answers, self.tell = [], []

    def zid(self):
        return "0123456789abcdef"

    def liveliness(self):
        return self

    def get(self, _key, timeout):
        assert timeout > 0
        return [SimpleNamespace(ok=SimpleNamespace(key_expr=key)) for key in self.answers]

    def declare_subscriber(self, _key, handler, *, history):
        assert history
        self.tell.append(handler)


@pytest.fixture
def session():
    return Session()


def sample(key, kind):
    return SimpleNamespace(key_expr=key, kind=kind)


def test_who_was_told_of_is_there_though_a_query_leaves_it_out(session):
    presence = Liveliness(session, "robot")
    old, new = (alive_key("robot", "estimator", f"{age:012x}~host~1~ab") for age in (1, 2))
    assert presence.alive() == set()
    session.tell[0](sample(old, zenoh.SampleKind.PUT))
    assert presence.alive() == {"estimator"}
    session.answers = [new]  # and what was not told of yet, a query knows
    assert presence.alive_instances() == {"estimator": [old.split("/")[-1], new.split("/")[-1]]}
    session.answers = []
    session.tell[0](sample(old, zenoh.SampleKind.DELETE))
    assert presence.alive() == set()
    assert len(session.tell) == 1
