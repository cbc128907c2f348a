"""The rules of the house that a walk over the imports can check."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent.parent
SERVICES = sorted(p.name for p in (ROOT / "services").iterdir() if (p / "__main__.py").exists())
SOURCES = sorted(p for room in ("common", "services", "presage") for p in (ROOT / room).rglob("*.py"))
# The thin shell: what may know of the bus, the clock and files. All else in a service is core.
SHELL = {"__main__.py", "service.py", "settings.py"}
# Files that are about files or threads themselves; no more may join unnoticed.
ALSO_SHELL = {
    "services/estimator/checkpoint.py", "services/estimator/weights.py",
    "services/estimator/precise/weights.py",
    "services/estimator/building.py",  # opens what the names name
    "services/estimator/fleet_service.py",  # the loop of many robots
    "services/estimator/model_card.py",  # reads the files a recording is to hold
    "services/viewer/web.py", "services/viewer/session.py", "services/viewer/desk.py",  # a web server
    "services/viewer/visitors.py", "services/viewer/control.py", "services/viewer/playback.py",
    "services/recorder/reader.py", "services/recorder/replay.py", "services/recorder/playing.py",
    "services/recorder/writer.py", "services/recorder/chunks.py", "services/recorder/index.py",
    "services/recorder/parts.py", "services/recorder/recording.py", "services/recorder/recover.py",
    "services/recorder/describing.py",  # a thread that asks
    "services/bridge_ros2/ros_session.py",  # the session on the robot's side
    "services/simulator/physics.py",  # pybullet reads the robot's URDF from a file
}  # fmt: skip
OUTSIDE = {
    "common.bus", "common.session", "common.presence", "common.loop", "common.leading",
    "common.service", "common.inbox", "common.config", "common.log", "zenoh",
    "time", "datetime", "os", "io", "pathlib", "shutil", "tempfile", "socket", "subprocess", "threading", "asyncio",
    "signal",
}  # fmt: skip


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> set[str]:
    """Modules a file imports when it runs; those under TYPE_CHECKING are no dependency of the program."""
    found: set[str] = set()

    def walk(node: ast.AST) -> None:
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
            found.add(node.module)
        for child in ast.iter_child_nodes(node):
            walk(child)

    walk(ast.parse(path.read_text()))
    return found


def reaches(path: Path, *modules: str) -> set[str]:
    return {i for i in imports(path) if any(i == m or i.startswith(m + ".") for m in modules)}


def cores() -> list[Path]:
    inside = [p for p in SOURCES if p.relative_to(ROOT).parts[0] == "services" and p.name not in SHELL]
    return [p for p in inside if name(p) not in ALSO_SHELL and p.name != "__init__.py"]


def test_there_is_something_to_look_at():
    assert set(SERVICES) >= {"simulator", "estimator", "controller", "recorder"}
    assert len(cores()) >= 5
    assert {"zenoh", "common.topics.Topic"} <= imports(ROOT / "common" / "bus.py")
    assert all((ROOT / also).exists() for also in ALSO_SHELL)


@pytest.mark.parametrize("path", cores(), ids=name)
def test_a_core_knows_no_bus_no_clock_and_no_files(path):
    assert not reaches(path, *OUTSIDE)
    calls = [
        n.func.id
        for n in ast.walk(ast.parse(path.read_text()))
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
    ]
    assert "open" not in calls


def test_zenoh_is_imported_by_the_bus_alone():
    assert [name(p) for p in SOURCES if reaches(p, "zenoh")] == [
        "common/bus.py",
        "common/presence.py",
        "common/session.py",
        "services/bridge_ros2/ros_session.py",  # the robot's side, where the bus's keys and rules are not those
    ]


@pytest.mark.parametrize("service", SERVICES)
def test_services_do_not_know_one_another(service):
    others = [f"services.{other}" for other in SERVICES if other != service] + ["presage"]
    for path in (ROOT / "services" / service).rglob("*.py"):
        assert not reaches(path, *others), name(path)


def test_common_knows_no_service():
    for path in (ROOT / "common").rglob("*.py"):
        assert not reaches(path, "services", "presage"), name(path)


def test_heavy_packages_stay_in_their_rooms():
    for path in SOURCES:
        room = path.relative_to(ROOT).parts[:2]
        assert room == ("services", "estimator") or not reaches(path, "torch", "safetensors"), name(path)
        assert room == ("services", "simulator") or not reaches(path, "pybullet"), name(path)
        assert room[0] == "presage" or not reaches(path, "typer", "rich", "matplotlib"), name(path)


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("services.controller.service", ["torch", "pybullet", "mcap"]),
        ("services.recorder.service", ["torch", "pybullet"]),
        ("services.simulator.service", ["torch", "mcap"]),
        ("services.estimator.service", ["pybullet", "mcap"]),
        ("services.estimator.__main__", ["torch"]),  # --help answers at once
        ("presage.cli", ["torch", "pybullet"]),
        ("common.describe", ["torch", "pybullet", "mcap"]),
    ],
)
def test_a_process_loads_only_what_is_its_own(module, absent):
    program = f"import sys, {module}; print(sorted(set({absent}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_pickle_anywhere():
    for path in SOURCES:
        assert not reaches(path, "pickle", "shelve", "marshal", "joblib", "dill"), name(path)
        assert "allow_pickle=True" not in path.read_text(), name(path)


def test_files_stay_small():
    long = {name(p): n for p in SOURCES if (n := len(p.read_text().splitlines())) > 300}
    assert not long


def test_a_walk_sees_what_it_should(tmp_path):
    path = tmp_path / "x.py"
    path.write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\n"
        "def f():\n    from common import bus\n    import os.path\n"
    )
    assert imports(path) == {"typing", "typing.TYPE_CHECKING", "common", "common.bus", "os.path"}
    assert reaches(path, "os") == {"os.path"}
    assert reaches(path, "common.bus") == {"common.bus"}
