"""The example reader of docs/recording.md, run outside of the project."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

from common.messages.topics import TRUTH
from services.recorder.files.writer import RecordingWriter
from tests.recorder import sessions as made

EXAMPLE = Path(__file__).resolve().parents[2] / "docs" / "examples" / "read_recording.py"


def test_example(tmp_path):
    file = made.write(tmp_path / "run.mcap")
    done = subprocess.run([sys.executable, EXAMPLE, file], capture_output=True, text=True, check=True, cwd=tmp_path)
    middle = sorted(made.error(i) for i in range(made.SCANS))[made.SCANS // 2]
    assert done.stdout.split() == f"{made.SCANS} beliefs, 91 beams, median error {middle:.4f} m".split()
    assert done.stderr == ""


def test_beliefs_that_were_recorded_before_their_truth(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap")
    for topic, service, message, at in made.events():
        at_ns = at + (10_000_000 if topic is TRUTH else 0)
        writer.write(topic, topic.key("robot", service), message.encode(), at_ns, at_ns)
    done = subprocess.run([sys.executable, EXAMPLE, writer.finish()], capture_output=True, text=True, check=True)
    assert done.stdout.startswith(f"{made.SCANS} beliefs, ")


def test_length_and_packages():
    source = EXAMPLE.read_text(encoding="utf-8")
    assert sum(bool(line.strip()) for line in source.splitlines()) <= 20
    found = {node.module if isinstance(node, ast.ImportFrom) else node.names[0].name
             for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Import | ast.ImportFrom)}  # fmt: skip
    assert {name.split(".")[0] for name in found} - sys.stdlib_module_names == {"mcap", "msgpack"}
