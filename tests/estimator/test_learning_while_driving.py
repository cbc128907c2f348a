"""The estimator learns while driving: kidnapping, the messages of the field, saving, and a replay of the session."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from structlog.testing import capture_logs

from common.bus.bus import wait_until
from common.bus.inbox import Inbox
from common.errors import UserError
from common.geometry import se2
from common.geometry.world import load_world
from common.messages.definitions import Belief, LearnedField, Pose, Scan
from common.messages.requests import SaveModelReply, SaveModelRequest
from common.messages.topics import BELIEF, FIELD, SAVE_MODEL, SCAN
from common.robot.scan_geometry import Sweep
from lab.accuracy.scenes import Scene
from services.estimator.factory import EstimatorOptions, ScannerGeometry, prepare_factory
from services.estimator.field_exchange import FieldAssembler, split_into_messages
from services.estimator.learner import LearningOutcome
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.key_scans import KeyScanCollector
from services.estimator.service import EstimatorService
from services.estimator.settings import EstimatorSettings
from tests.conftest import ROOT, WAIT_TIMEOUT_S, received_messages
from tests.estimator.test_service import StoringService

PERIOD_S, STEP_M, BEAMS = 0.5, 0.25, 120
WORLD = """
name: shifted
boundary: [[-0.02, -0.02], [8.02, -0.02], [8.02, 5.02], [-0.02, 5.02]]
obstacles:
  - box: {center: [2, 1.5], size: [0.6, 0.9], yaw_deg: 20}
  - circle: {center: [6, 3.5], radius: 0.4}
  - box: {center: [2.7, 3.1], size: [1.4, 0.3], yaw_deg: 10}
  - polygon: [[5.2, 0], [6.2, 0], [5.6, 0.5]]
"""
TRUE_WORLD = WORLD.replace("-0.02", "0").replace(".02", "").replace("shifted", "exact")


@pytest.fixture
def worlds(tmp_path):
    """A rough map in a file, and the true world."""
    for name, text in (("rough", WORLD), ("true", TRUE_WORLD)):
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path / "rough.yaml", load_world(str(tmp_path / "true.yaml"))


def drive(world, metres):
    """Poses and scans of a drive to and fro between corners of the room."""
    scene = Scene.of(world, BEAMS, 5000)
    corners = np.array([[1.0, 0.6], [4.5, 1.0], [7.2, 1.0], [4.5, 2.5], [7.2, 4.4], [4.5, 4.2], [0.8, 4.2], [1.0, 2.8]])
    route = np.concatenate([corners] * 5)
    legs = np.hypot(*np.diff(route, axis=0).T).cumsum()
    at = np.arange(0.0, metres, STEP_M)
    x, y = (np.interp(at, np.concatenate([[0.0], legs]), route[:, axis]) for axis in (0, 1))
    poses = np.column_stack([x, y, se2.wrap(0.2 * at)])
    return poses, [scene.observe(clean, 0.0).ranges for clean in scene.clean(poses)], scene.scanner


def scan_message(scanner, k, ranges):
    first, increment, _ = Sweep.of_angles(scanner.angles())
    return Scan(
        stamp_ns=round(PERIOD_S * 1e9) * (k + 1), angle_min=first, angle_increment=increment, range_min=0.05,
        range_max=scanner.range_max, ranges=ranges, mount=Pose.of(np.array(scanner.mount)), sigma=scanner.sigma,
    )  # fmt: skip


def test_kidnapping_while_learning():
    """What the estimator saw while it took another place for its own is not learned."""
    office = load_world("office")
    scene = Scene.of(office, 180, 5000)
    before, after = (
        scene.path(20.0, start=np.array([2.0, 3.9, 0.0])),
        scene.path(16.0, start=np.array([13.0, 4.0, 1.0])),
    )
    path, rate = np.concatenate([before, after]), scene.scanner.rate
    estimator = prepare_factory(EstimatorOptions(office, model="exact"))(ScannerGeometry.of(scene.scanner))
    estimator.restart(path[0])
    keys = KeyScanCollector(scene.scanner.angles(), np.array(scene.scanner.mount), scene.scanner.range_max)
    for k, clean in enumerate(scene.clean(path)):
        observation = scene.observe(clean, k / rate)
        keys.add(estimator.update(observation), observation)
    assert keys.dropped_total > 0
    assert len(keys) > 20
    for key in keys.verified.values():
        assert np.hypot(*(key.pose - path[round(key.stamp * rate)])[:2]) < 0.1


def test_learn_save_and_follow(process, bus, worlds, tmp_path):
    rough, true = worlds
    poses, scans, scanner = drive(true, 45)
    beliefs, fields, stored = Inbox(), Inbox(), []
    bus.subscribe(BELIEF, beliefs, keep_all=True)
    bus.subscribe(FIELD, fields, keep_all=True)
    start = ",".join(map(str, (*poses[0, :2], np.rad2deg(poses[0, 2]))))
    settings = {"world": str(rough), "model": "exact", "initial_pose": start}
    options = [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]
    running = process("estimator", *options, "--learn", "refine", "--saved-models", str(tmp_path / "saved"))
    assert bus.wait_matching(SCAN, WAIT_TIMEOUT_S)
    assert "nothing was learned" in bus.query(SAVE_MODEL, SaveModelRequest(name="monday"), SaveModelReply).reason
    sent = []

    def send(k):
        message = scan_message(scanner, len(sent), scans[k])
        sent.append(message)
        bus.put(SCAN, message.encode())
        assert wait_until(lambda: any(collect(beliefs, Belief, message.stamp_ns)), WAIT_TIMEOUT_S)

    def collect(inbox, kind, stamp_ns):
        new = list(received_messages(inbox, kind))
        stored.extend(new)
        return (each for each in new if each.stamp_ns == stamp_ns)

    for k in range(len(scans)):
        send(k)
    # The robot stands until a version is learned from the scans so far.
    assert wait_until(lambda: send(len(scans) - 1) or stored[-1].field_version > 0, 120), running.output
    assert {belief.state for belief in stored[-20:]} == {"tracking"}

    parts = list(received_messages(fields, LearnedField))
    assembler = FieldAssembler()
    data = next(data for part in parts if (data := assembler.add(part)) is not None)
    reply = bus.query(SAVE_MODEL, SaveModelRequest(name="monday"), SaveModelReply)
    assert reply.ok, reply.reason
    assert reply.version == stored[-1].field_version
    assert "exists already" in bus.query(SAVE_MODEL, SaveModelRequest(name="monday"), SaveModelReply).reason
    (tmp_path / "saved" / "tuesday-precise.json").touch()
    assert "exists already" in bus.query(SAVE_MODEL, SaveModelRequest(name="tuesday"), SaveModelReply).reason
    assert "letters" in bus.query(SAVE_MODEL, SaveModelRequest(name="../monday"), SaveModelReply).reason
    saved = tmp_path / "saved" / "monday-precise.safetensors"
    model, _, card = weights.load(saved)
    assert "key scans while driving" in card.source
    if reply.version == 1:
        assert np.array_equal(model.field.phi, weights.decode(data)[0].field.phi)

    # Another estimator that follows the recorded messages has the same beliefs.
    replayed = StoringService(EstimatorSettings(**settings, learn="follow"))
    replayed.open()
    for message in sent:
        replayed.on_message(SCAN, message)
        for part in parts:
            if part.stamp_ns == message.stamp_ns:
                replayed.on_message(FIELD, part)
    again = {each.stamp_ns: each for each in replayed.sent if isinstance(each, Belief)}
    assert len(again) == len(stored)
    for belief in stored:
        assert again[belief.stamp_ns].pose == belief.pose
        assert again[belief.stamp_ns].field_version == belief.field_version


def test_follows_a_restarted_estimator(monkeypatch):
    """The versions of a restarted estimator begin again at 1; repeated fields are used once."""
    follower = StoringService(EstimatorSettings(world="corridor", learn="follow"))
    follower.open()
    _, (scan, *_), scanner = drive(load_world("corridor"), 1)
    follower.on_message(SCAN, scan_message(scanner, 0, scan))
    use_model = Mock(wraps=follower.estimator.use_model)
    monkeypatch.setattr(follower.estimator, "use_model", use_model)
    model, places = follower.estimator.model, follower.estimator.seeds.places
    for k, offset in enumerate((0.0, 0.0, 0.1)):
        field = replace(model.field, phi=model.field.phi + offset)
        data = weights.encode(replace(model, field=field), places)
        for part in split_into_messages(data, 1, follower.model.sha256, k):
            follower.on_message(FIELD, part)
    used = [call.args[0].field.phi.mean() for call in use_model.call_args_list]
    assert np.diff(used) == pytest.approx([0.1], abs=1e-3)


def test_parts():
    data = np.random.default_rng(0).bytes(1_300_000)
    first, second = (split_into_messages(data, version, "base", version) for version in (1, 2))
    assert len(first) == 3
    assembler = FieldAssembler()
    assert [assembler.add(part) for part in first] == [None, None, data]
    assert assembler.add(second[0]) is assembler.add(second[2]) is None  # one is missing
    assert [assembler.add(part) for part in (first[0], second[1], second[2])] == [None, None, None]
    assert [assembler.add(part) for part in second][-1] == data


def test_only_precise_learns():
    with pytest.raises(UserError, match="only estimator precise learns"):
        EstimatorService(EstimatorSettings(estimator="particle-filter", learn="refine")).open()


def test_rejected_versions_are_reported():
    """If the map is as good as the scans, no version is better, and the user learns why there is nothing to save."""
    service = EstimatorService(EstimatorSettings(learn="refine"))
    service.open()
    with pytest.raises(UserError, match="nothing was learned: start with `presage up --learn`"):
        service.on_request(SAVE_MODEL, SaveModelRequest(name="monday"))
    outcomes = []
    learner = SimpleNamespace(keys=range(12), rejected_total=0, take=lambda: outcomes.pop() if outcomes else None)
    service._learner = learner
    with pytest.raises(UserError, match="12 key scans, and a version needs 50"):
        service.on_request(SAVE_MODEL, SaveModelRequest(name="monday"))
    service.counters["versions_rejected"] = 5  # with another scanner, whose learner was another one
    learner.rejected_total = 2
    outcomes.append(LearningOutcome(None))
    with capture_logs() as lines:
        for stamp_ns in (1, 2):
            service._use_learned_version(learner, None, stamp_ns)
    assert [line["event"] for line in lines] == ["a new version predicts new scans no better, so the model stays"]
    assert service.counters["versions_rejected"] == 6
    with pytest.raises(UserError, match="2 new versions predicted new scans no better"):
        service.on_request(SAVE_MODEL, SaveModelRequest(name="monday"))


@pytest.mark.parametrize(("world", "warnings"), [("office", 1), ("corridor", 0)])
def test_model_of_another_world_is_reported(world, warnings):
    service = EstimatorService(EstimatorSettings(world=world, model=str(ROOT / "models/corridor-precise.safetensors")))
    with capture_logs() as lines:
        service.open()
    assert sum("learned in another world" in line["event"] for line in lines) == warnings
