"""Liveliness tokens that a query misses."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import zenoh

from common.bus.liveliness import Liveliness
from common.messages.topics import alive_key


class Session:
    """A fake zenoh session: queries return ``answers``, and the test calls the subscribers."""

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


def test_missed_tokens(session):
    presence = Liveliness(session, "robot")
    old, new = (alive_key("robot", "estimator", f"{age:012x}~host~1~ab") for age in (1, 2))
    assert presence.alive() == set()
    session.tell[0](sample(old, zenoh.SampleKind.PUT))
    assert presence.alive() == {"estimator"}
    session.answers = [new]  # the query finds a token that was not reported yet
    assert presence.alive_instances() == {"estimator": [old.split("/")[-1], new.split("/")[-1]]}
    session.answers = []
    session.tell[0](sample(old, zenoh.SampleKind.DELETE))
    assert presence.alive() == set()
    assert len(session.tell) == 1
