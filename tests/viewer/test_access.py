"""Access: only pages of this server, under its own address, with the token if there is one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from services.viewer.access import is_token, known_host, same_origin, token_of
from services.viewer.server import link, listen
from services.viewer.settings import ViewerSettings

HERE = "127.0.0.1:8080"


@pytest.mark.parametrize(
    ("origin", "host", "same"),
    [
        ("http://127.0.0.1:8080", HERE, True),
        ("http://LOCALHOST:8080", "localhost:8080", True),
        ("http://[::1]:8080", "[::1]:8080", True),
        ("http://robot.lan", "robot.lan", True),
        ("https://robot.lan", "robot.lan:443", True),
        (None, HERE, False),
        ("", HERE, False),
        ("null", HERE, False),
        ("http://127.0.0.1:8081", HERE, False),
        ("http://127.0.0.1", HERE, False),
        ("http://localhost:8080", HERE, False),
        ("http://evil.example", HERE, False),
        ("http://127.0.0.1:8080.evil.example", HERE, False),
        ("http://127.0.0.1:8080@evil.example", HERE, False),
        ("file://127.0.0.1:8080", HERE, False),
        ("http://127.0.0.1:99999", "127.0.0.1:99999", False),
        ("http://127.0.0.1:8080", None, False),
        ("http://", "", False),
        ("http://[::1", "[::1", False),
    ],
)
def test_origins(origin, host, same):
    assert same_origin(origin, host) is same


def test_hosts():
    known = (HERE, "localhost", "[::1]:80", "192.168.1.7:8080", "robot:80", "a.localhost")
    foreign = (None, "", "evil.example:8080", "localhost.evil.example", "robot.evil.example", "a@127.0.0.1")
    assert [host for host in (*known, *foreign) if known_host(host, {"robot"})] == list(known)


@given(st.text(), st.text())
def test_any_headers(origin, host):
    assert same_origin(origin, host) in {True, False}
    assert known_host(host, set()) in {True, False}
    assert isinstance(token_of(origin, host), str)
    assert not is_token(origin + "x", "")


def test_tokens():
    assert token_of(None, "") == ""
    assert token_of("a=b; presage_token=tea; c=d", "") == "tea"
    assert token_of("presage_token=old", "token=tea") == "tea"
    assert is_token("tea", "tea")
    assert not is_token("te", "tea")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.9", "::1", "localhost", "0.0.0.0", "::", "192.168.1.7"])
def test_control_by_default_on_loopback_only(host):
    assert ViewerSettings(host=host).control is (host in {"127.0.0.1", "127.0.0.9", "::1", "localhost"})
    assert ViewerSettings(host=host, allow_control=True).control


def test_token_in_no_recording():
    settings = ViewerSettings(token="tea")
    assert settings.effective()["token"] == "set"
    assert "tea" not in str(settings.effective())


def test_port_in_use():
    with listen(ViewerSettings(port=0)) as first:
        port = first.getsockname()[1]
        with pytest.raises(UserError, match=f"127.0.0.1 port {port} cannot be used.*--port"):
            listen(ViewerSettings(port=port))
        # Without --port, the next free port is used.
        with listen(ViewerSettings()) as second, listen(ViewerSettings()) as third:
            assert second.getsockname()[1] != third.getsockname()[1]


def test_address_of_another_machine():
    with pytest.raises(UserError, match=r"192.0.2.1 port 0 cannot be used"):
        listen(ViewerSettings(host="192.0.2.1", port=0))


def test_link():
    with listen(ViewerSettings(host="0.0.0.0", port=0)) as listener:
        port = listener.getsockname()[1]
        assert link(ViewerSettings(host="0.0.0.0", port=0), listener) == f"http://127.0.0.1:{port}/"
        assert link(ViewerSettings(token="tea"), listener) == f"http://127.0.0.1:{port}/?token=tea"
        assert link(ViewerSettings(address="https://robot.lan"), listener) == "https://robot.lan/"
