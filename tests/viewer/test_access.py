"""Access: only pages of this server, under its own address, with the token if there is one."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from services.viewer.access import is_token, known_host, same_origin, token_of
from services.viewer.server import link, listen
from services.viewer.settings import ViewerSettings


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080"),
        ("http://LOCALHOST:8080", "localhost:8080"),
        ("http://[::1]:8080", "[::1]:8080"),
        ("http://robot.lan", "robot.lan"),
        ("https://robot.lan", "robot.lan:443"),
    ],
)
def test_the_own_page_may_connect(origin, host):
    assert same_origin(origin, host)


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        (None, "127.0.0.1:8080"),
        ("", "127.0.0.1:8080"),
        ("null", "127.0.0.1:8080"),
        ("http://127.0.0.1:8081", "127.0.0.1:8080"),
        ("http://127.0.0.1", "127.0.0.1:8080"),
        ("http://localhost:8080", "127.0.0.1:8080"),
        ("http://evil.example", "127.0.0.1:8080"),
        ("http://127.0.0.1:8080.evil.example", "127.0.0.1:8080"),
        ("http://127.0.0.1:8080@evil.example", "127.0.0.1:8080"),
        ("file://127.0.0.1:8080", "127.0.0.1:8080"),
        ("http://127.0.0.1:99999", "127.0.0.1:99999"),
        ("http://127.0.0.1:8080", None),
        ("http://", ""),
        ("http://[::1", "[::1"),
    ],
)
def test_another_page_may_not(origin, host):
    assert not same_origin(origin, host)


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8080", "localhost", "[::1]:80", "192.168.1.7:8080", "robot:80", "a.localhost"]
)
def test_an_address_is_known(host):
    assert known_host(host, {"robot"})


@pytest.mark.parametrize(
    "host", [None, "", "evil.example:8080", "localhost.evil.example", "robot.evil.example", "a@127.0.0.1"]
)
def test_a_name_that_may_be_anybodys_is_not(host):
    assert not known_host(host, {"robot"})


@given(st.text(), st.text())
def test_no_header_is_too_strange(origin, host):
    assert same_origin(origin, host) in {True, False}
    assert known_host(host, set()) in {True, False}
    assert isinstance(token_of(origin, host), str)
    assert not is_token(origin + "x", "")


def test_a_token_comes_with_the_address_or_the_cookie():
    assert token_of(None, "") == ""
    assert token_of("a=b; presage_token=tea; c=d", "") == "tea"
    assert token_of("presage_token=old", "token=tea") == "tea"
    assert is_token("tea", "tea")
    assert not is_token("te", "tea")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.9", "::1", "localhost"])
def test_on_loopback_visitors_may_act(host):
    assert ViewerSettings(host=host).control


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.7", "robot.lan"])
def test_beyond_it_they_watch_unless_told(host):
    assert not ViewerSettings(host=host).control
    assert ViewerSettings(host=host, allow_control=True).control


def test_the_token_gets_into_no_recording():
    settings = ViewerSettings(token="tea")
    assert settings.effective()["token"] == "set"
    assert "tea" not in str(settings.effective())


def test_a_port_that_was_asked_for_and_is_taken_is_said():
    with listen(ViewerSettings(port=0)) as first:
        port = first.getsockname()[1]
        with pytest.raises(UserError, match=f"127.0.0.1 port {port} cannot be used.*--port"):
            listen(ViewerSettings(port=port))
        # Without --port, the next free port is used.
        with listen(ViewerSettings()) as second, listen(ViewerSettings()) as third:
            assert second.getsockname()[1] != third.getsockname()[1]


def test_an_address_that_is_none_of_this_machine_is_said():
    with pytest.raises(UserError, match=r"192.0.2.1 port 0 cannot be used"):
        listen(ViewerSettings(host="192.0.2.1", port=0))


def test_the_link_is_for_a_browser_here():
    with listen(ViewerSettings(host="0.0.0.0", port=0)) as listener:
        port = listener.getsockname()[1]
        assert link(ViewerSettings(host="0.0.0.0", port=0), listener) == f"http://127.0.0.1:{port}/"
        assert link(ViewerSettings(token="tea"), listener) == f"http://127.0.0.1:{port}/?token=tea"
        assert link(ViewerSettings(address="https://robot.lan"), listener) == "https://robot.lan/"
