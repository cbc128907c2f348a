"""Which session a command connects to."""

from __future__ import annotations

import json

import psutil
import pytest

from common.bus.bus import DEFAULT_ENDPOINT
from common.errors import UserError
from common.runtime.session_files import runtime_folder, session_file
from presage.session import credentials as secure
from presage.session.running_sessions import OBSERVER, find_session, link_of

HERE = "tcp/127.0.0.1:7001"


@pytest.mark.parametrize(("connect", "endpoint"), [("", DEFAULT_ENDPOINT), ("tcp/far:1", "tcp/far:1")])
def test_without_a_session(connect, endpoint):
    link = link_of(connect, "")
    assert (link.connect, link.robot, link.security) == ((endpoint,), "robot", None)


def test_one_session_and_its_robot(tmp_path):
    secure.init(tmp_path)
    with session_file(HERE, ["truck"], link_security(tmp_path), {}):
        link = link_of("", "", OBSERVER)
        assert (link.connect, link.robot, link.security.member.name) == ((HERE,), "truck", "observer")
        assert link_of("tcp/far:1", "").robot == "robot"
    assert find_session("").endpoint == DEFAULT_ENDPOINT
    assert not list(runtime_folder().iterdir())


def link_security(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PRESAGE_SECURITY", str(folder))
        return link_of("", "").security


def test_several_robots_need_a_name():
    with session_file(HERE, ["r-1", "r-2"], None, {}):
        assert link_of("", "r-2").robot == "r-2"
        with pytest.raises(UserError, match=r"several robots .* --robot`: r-1, r-2"):
            link_of("", "")


def write_session(pid, started, endpoint):
    session = {"endpoint": endpoint, "robots": ["robot"], "security": "", "pid": pid, "started": started}
    runtime_folder().mkdir(exist_ok=True)
    (runtime_folder() / f"{endpoint[-4:]}.json").write_text(json.dumps(session))


def test_several_sessions_are_listed():
    me = psutil.Process()
    for port in (7001, 7002):
        write_session(me.pid, me.create_time(), f"tcp/127.0.0.1:{port}")
    with pytest.raises(UserError, match=r"several sessions .*:7001 \(robot\); .*:7002 \(robot\)"):
        find_session("")
    assert find_session(HERE).pid == me.pid


def test_stale_files_are_ignored():
    me = psutil.Process()
    write_session(me.pid, me.create_time() - 1, HERE)  # an earlier process with the same pid
    (runtime_folder() / "broken.json").write_text("{")
    assert find_session("").endpoint == DEFAULT_ENDPOINT


@pytest.mark.parametrize("name", ["*", "robot-*", "a?b", "#", "/", "robot 1", "$*", "x" * 65])
def test_names_that_no_robot_can_have(name):
    """The wildcards of zenoh would address all robots."""
    with pytest.raises(UserError, match=r"^robot .*: give the name of one robot"):
        link_of("", name)
