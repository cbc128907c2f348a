"""docs/prometheus: what it asks for exists; `promtool` says whether Prometheus takes it."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from common.messages.definitions import Belief
from common.runtime.metrics import METRICS, STATES
from presage.diagnosis import bus_observation as listening
from presage.diagnosis import installation, machine
from presage.diagnosis import rules as judging
from tests.conftest import ROOT

FOLDER = ROOT / "docs" / "prometheus"
PAGE = (ROOT / "docs" / "operations.md").read_text()


def rules() -> list[dict]:
    (group,) = yaml.safe_load((FOLDER / "alerts.yml").read_text())["groups"]
    return group["rules"]


def test_metrics_of_alerts():
    known = {row.sample: row for row in METRICS} | {r.name + "_bucket": r for r in METRICS if r.kind == "histogram"}
    asked = 0
    for rule in rules():
        for name, chosen in re.findall(r"(presage_\w+)(?:\{([^}]*)\})?", rule["expr"]):
            assert name in known, rule
            assert set(re.findall(r"(\w+)!?=", chosen)) <= set(known[name].labels), rule
            asked += 1
        labels = {label for row in known.values() for label in row.labels} | {"instance"}
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= labels
    assert asked >= len(rules())
    assert "lost" in STATES[Belief]


def test_prometheus_configuration():
    if (tool := shutil.which("promtool")) is None:
        pytest.skip("needs promtool, of Prometheus: docs/prometheus is not checked by Prometheus itself")
    done = subprocess.run([tool, "check", "config", "prometheus.yml"], cwd=FOLDER, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_page_explains_every_finding():
    sources = [Path(module.__file__).read_text() for module in (installation, judging, listening, machine)]
    codes = {code for text in sources for code in re.findall(r'Finding\(\s*"(\w+)"', text)}
    assert len(codes) > 15
    assert {code for code in codes if f"`{code}`" not in PAGE} <= {"note"}
