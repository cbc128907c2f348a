"""The architecture (docs/architecture.md), checked on the imports: layers, cores without input or output, no cycles."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests import folder_list

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("common", "services", "presage", "lab")
# Each layer imports only those before it; what shares a line imports nothing of one another.
LAYERS = (
    (
        "common.errors", "common.limits", "common.versions", "common.processes", "common.log_capture",
        "common.yaml_text", "common.names", "common.writing",
    ),
    ("common.log", "common.packages"),
    ("common.geometry",),
    ("common.robot",),
    ("common.messages",),
    ("common.bus",),
    ("common.runtime",),
    ("common.router", "common.containers"),
    (
        "services.simulator", "services.estimator", "services.controller", "services.recorder", "services.viewer",
        "services.mapper", "services.bridge_ros2",
    ),
    ("presage",),
    ("lab",),
)  # fmt: skip
COMMANDS = "presage/cli/main.py"  # the one file of presage that names lab: it makes one command line of both
SERVICES = sorted(p.name for p in (ROOT / "services").iterdir() if (p / "__main__.py").exists())
SOURCES = sorted(p for package in PACKAGES for p in (ROOT / package).rglob("*.py"))
# A service's shell may use the bus, the clock and files; everything else is its core.
SHELL = {"__main__.py", "service.py", "settings.py"}
ALSO_SHELL = {
    "services/estimator/factory.py",  # opens the files that settings name
    "services/estimator/model_card.py",
    "services/estimator/multi_robot.py",
    "services/estimator/paper/checkpoint.py",
    "services/estimator/paper/weights.py",
    "services/estimator/precise/learning/weights.py",
    "services/estimator/shared/model_folder.py",
    "services/viewer/control.py",
    "services/viewer/request_handler.py",
    "services/viewer/playback.py",
    "services/viewer/server.py",
    "services/viewer/visitor_session.py",
    "services/viewer/visitors.py",
    "services/recorder/reader.py",
    "services/recorder/recording.py",
    "services/recorder/recover.py",
    "services/recorder/session_description.py",
    "services/recorder/replaying/replay.py",
    "services/recorder/files/chunks.py",
    "services/recorder/files/index.py",
    "services/estimator/learner.py",  # learns in a process of its own
    "services/recorder/files/parts.py",
    "services/recorder/files/writer.py",
    "services/bridge_ros2/ros_session.py",
    "services/simulator/pybullet_physics.py",  # pybullet reads the robot's URDF from a file
}
INPUT_AND_OUTPUT = {
    "common.bus.bus", "common.bus.session", "common.bus.liveliness", "common.bus.leader_election", "common.bus.inbox",
    "common.runtime.service_loop", "common.runtime.service", "common.runtime.config", "common.log", "zenoh",
    "time", "datetime", "os", "io", "pathlib", "shutil", "tempfile", "socket", "subprocess", "threading", "asyncio",
    "signal",
}  # fmt: skip


def name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def module(path: Path) -> str:
    return name(path).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
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

    walk(tree(path))
    return found


def reaches(path: Path, *modules: str) -> set[str]:
    return {i for i in imports(path) if any(i == m or i.startswith(m + ".") for m in modules)}


def cores() -> list[Path]:
    inside = [p for p in SOURCES if p.relative_to(ROOT).parts[0] == "services" and p.name not in SHELL]
    return [p for p in inside if name(p) not in ALSO_SHELL and p.name != "__init__.py"]


def cycle(edges: dict[str, set[str]]) -> list[str]:
    """One cycle of the graph, or nothing."""
    finished: set[str] = set()

    def follow(node: str, path: list[str]) -> list[str]:
        if node in path:
            return [*path[path.index(node) :], node]
        if node in finished:
            return []
        for following in sorted(edges.get(node, ())):
            if found := follow(following, [*path, node]):
                return found
        finished.add(node)
        return []

    return next((found for node in sorted(edges) if (found := follow(node, []))), [])


def module_edges() -> dict[str, set[str]]:
    files = {module(p): p for p in SOURCES if p.name != "__init__.py" and name(p) != COMMANDS}
    return {own: (imports(path) & files.keys()) - {own} for own, path in files.items()}


def test_sources_found():
    assert set(SERVICES) >= {"simulator", "estimator", "controller", "recorder"}
    assert len(cores()) >= 5
    assert {"zenoh", "common.messages.topics.Topic"} <= imports(ROOT / "common" / "bus" / "bus.py")
    assert all((ROOT / also).exists() for also in ALSO_SHELL)


@pytest.mark.parametrize("path", cores(), ids=name)
def test_core_uses_no_bus_clock_or_files(path):
    assert not reaches(path, *INPUT_AND_OUTPUT)
    calls = [n.func.id for n in ast.walk(tree(path)) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)]
    assert "open" not in calls


@pytest.mark.parametrize("layer", range(len(LAYERS)), ids=lambda layer: LAYERS[layer][0])
def test_layers(layer):
    above = [package for packages in LAYERS[layer + 1 :] for package in packages]
    for package in LAYERS[layer]:
        forbidden = [*above, *(other for other in LAYERS[layer] if other != package)]
        folder = ROOT / package.replace(".", "/")
        for path in [folder.with_suffix(".py")] if not folder.is_dir() else sorted(folder.rglob("*.py")):
            if name(path) != COMMANDS:
                assert not reaches(path, *forbidden), name(path)


def test_every_module_has_a_layer():
    packages = [package for packages in LAYERS for package in packages]
    for path in SOURCES:
        if path.name != "__init__.py":
            assert any(f"{module(path)}.".startswith(f"{package}.") for package in packages), name(path)


def test_no_module_cycles():
    assert not cycle(module_edges())


def test_no_package_cycles():
    edges: dict[str, set[str]] = {}
    for source, targets in module_edges().items():
        own = source.rpartition(".")[0]
        edges.setdefault(own, set()).update({target.rpartition(".")[0] for target in targets} - {own, ""})
    assert not cycle({own: {t for t in targets if t in edges} for own, targets in edges.items()})


def test_cycle_is_found():
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["b", "c", "b"]
    assert not cycle({"a": {"b", "c"}, "b": {"c"}})


def test_zenoh_stays_in_the_bus():
    assert [name(p) for p in SOURCES if reaches(p, "zenoh")] == [
        "common/bus/bus.py",
        "common/bus/liveliness.py",
        "common/bus/session.py",
        "services/bridge_ros2/ros_session.py",  # the ROS side has other keys and rules than the bus
    ]


def test_heavy_packages():
    for path in SOURCES:
        package = path.relative_to(ROOT).parts[:2]
        if package[0] != "lab":
            assert package == ("services", "estimator") or not reaches(path, "torch", "safetensors"), name(path)
        assert package == ("services", "simulator") or not reaches(path, "pybullet"), name(path)
        assert package[0] in {"presage", "lab"} or not reaches(path, "typer", "rich", "matplotlib"), name(path)


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("services.controller.service", ["torch", "pybullet", "mcap"]),
        ("services.recorder.service", ["torch", "pybullet", "numba"]),
        ("services.simulator.service", ["torch", "mcap", "numba"]),
        ("services.estimator.service", ["pybullet", "mcap"]),
        ("services.estimator.__main__", ["torch"]),  # --help answers at once
        ("presage.cli.main", ["torch", "pybullet", "numba"]),
        ("common.messages.reference", ["torch", "pybullet", "mcap"]),
    ],
)
def test_packages_of_a_process(module, absent):
    program = f"import sys, {module}; print(sorted(set({absent}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_pickle():
    for path in SOURCES:
        assert not reaches(path, "pickle", "shelve", "marshal", "joblib", "dill"), name(path)
        assert "allow_pickle=True" not in path.read_text(), name(path)


def test_architecture_page():
    page = folder_list.PAGE.read_text(encoding="utf-8")
    assert folder_list.fill(page) == page, "run: python -m tests.folder_list"


def test_imports(tmp_path):
    path = tmp_path / "x.py"
    path.write_text(
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\n"
        "def f():\n    from common import bus\n    import os.path\n"
    )
    assert imports(path) == {"typing", "typing.TYPE_CHECKING", "common", "common.bus", "os.path"}
    assert reaches(path, "os") == {"os.path"}
    assert reaches(path, "common.bus") == {"common.bus"}
