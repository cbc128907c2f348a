"""Queries to services, their repetition, and the records made of the replies."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from common.bus.bus import wait_until
from common.errors import UserError
from common.geometry.world import World
from common.log import logger
from common.messages.requests import ConfigReply, ModelReply, WorldReply
from common.messages.topics import CONFIG, MODEL, WORLD
from common.robot.robot import Robot
from services.recorder import session_description
from services.recorder.session_description import (
    AttachmentRecord,
    DescriptionCollector,
    MetadataRecord,
    description_records,
)
from tests.conftest import WAIT_TIMEOUT_S
from tests.recorder.sessions import SCANNER
from tests.recorder.sessions import WORLD as HALL

WEIGHTS = np.frombuffer(b"\x00\x01\xff" * 100, np.uint8)
FILE = "hall-precise.safetensors"
MODEL_OF_HALL = ModelReply(estimator="precise", world=HALL, card='{"a": 1}', file=FILE, size=300, sha256="ab")


def stored(service, answer):
    """Metadata by name and attachments by name."""
    records = list(description_records(service, answer))
    metadata = {r.name: r.values for r in records if isinstance(r, MetadataRecord)}
    attachments = {r.name: r.data for r in records if isinstance(r, AttachmentRecord)}
    assert len(metadata) + len(attachments) == len(records)
    assert isinstance(records[-1], MetadataRecord)  # metadata follows the attachments that it refers to
    return metadata, attachments


def test_configuration():
    reply = ConfigReply(service="x", config='{"seed": 1}', versions={"python": "3.11", "commit": "abc"})
    assert stored("x", reply) == ({"config:x": {"config": '{"seed": 1}', "python": "3.11", "commit": "abc"}}, {})


def test_world():
    metadata, attachments = stored("simulator", WorldReply(world=HALL, scanner=SCANNER, robot=Robot(radius=0.3)))
    assert World.model_validate(yaml.safe_load(attachments["world.yaml"])) == HALL
    assert metadata["world"].keys() == {"scanner", "robot"}
    assert json.loads(metadata["world"]["scanner"])["beams"] == SCANNER.beams
    assert json.loads(metadata["world"]["robot"])["radius"] == 0.3


DESCRIBED = {"estimator": "precise", "card": '{"a": 1}', "file": FILE, "size": "300", "sha256": "ab"}
NOT_LEARNED = {"estimator": "amcl", "card": "", "file": "", "weights": "none: nothing was learned"}


@pytest.mark.parametrize(
    ("reply", "metadata", "names"),
    [
        (
            MODEL_OF_HALL.model_copy(update={"weights": WEIGHTS}),
            DESCRIBED | {"weights": "stored"},
            {"model/hall-precise.json", f"model/{FILE}"},
        ),
        (MODEL_OF_HALL, DESCRIBED | {"weights": "not stored"}, {"model/hall-precise.json"}),
        (ModelReply(estimator="amcl", world=HALL), NOT_LEARNED, set()),
    ],
    ids=["with weights", "without weights", "not learned"],
)
def test_model(reply, metadata, names):
    found, attachments = stored("estimator", reply)
    assert found == {"model": metadata}
    assert attachments.keys() == {"model/world.yaml"} | names
    assert World.model_validate(yaml.safe_load(attachments["model/world.yaml"])) == HALL
    assert attachments.get("model/hall-precise.json", b'{"a": 1}') == b'{"a": 1}'
    assert attachments.get(f"model/{FILE}", WEIGHTS.tobytes()) == WEIGHTS.tobytes()


@given(st.text(st.characters(codec="utf-8"), max_size=30).map(lambda name: f"{name}.safetensors"))
@example("../x.safetensors")
@example("/x.safetensors")
@example("x.safetensors\n")
@example("x.so")
def test_file_names_from_the_bus(name):
    metadata, attachments = stored("estimator", MODEL_OF_HALL.model_copy(update={"file": name, "weights": WEIGHTS}))
    for attachment in attachments:
        assert attachment.startswith("model/")
        assert not set(attachment.removeprefix("model/")) & set("/\\\0\n")
    assert (f"model/{name}" in attachments) == (metadata["model"]["file"] == name)


class FakeBus:
    """Simulates services that answer, or do not, and records all queries."""

    def __init__(self):
        self.asked, self.replies = [], {}
        self.changed = lambda service, there: None

    def watch_alive(self, changed):
        self.changed = changed

    def query(self, query, request, reply, timeout, service="*"):
        self.asked.append((service if query.per_service else query.server, query.name))
        answer = self.replies.get(self.asked[-1])
        answer = answer(request) if callable(answer) else answer
        if answer is None:
            raise UserError(f"nobody answers {query.name}")
        assert type(answer) is reply
        return answer

    def count(self, service, query):
        return self.asked.count((service, query))


@pytest.fixture
def bus():
    return FakeBus()


@pytest.fixture
def collect(bus, monkeypatch):
    """A function that creates a collector, without delays. All collectors are stopped after the test."""
    for name in ("RETRY_DELAY_S", "MODEL_RETRY_DELAY_S", "MODEL_RECHECK_PERIOD_S"):
        monkeypatch.setattr(session_description, name, 0.01)
    made = []

    def make(*, weights=True):
        made.append(DescriptionCollector(bus, "recorder", logger("test"), weights=weights))
        return made[-1]

    yield make
    for each in made:
        each.stop()
        each.join()
        assert not each._thread.is_alive()


def next_answers(collector, count):
    found = []

    def check():
        found.extend(collector.new_replies())
        return len(found) >= count

    assert wait_until(check, WAIT_TIMEOUT_S), found
    return found


def config(seed):
    return ConfigReply(service="simulator", config=json.dumps({"seed": seed}))


def test_each_service_answers_its_queries(bus, collect):
    bus.replies = {
        ("simulator", "config"): config(1),
        ("simulator", "world"): WorldReply(world=HALL),
        ("estimator", "config"): config(2),
        ("estimator", "model"): MODEL_OF_HALL,
        ("other", "config"): config(3),
    }
    collector = collect(weights=False)
    for service in ("simulator", "estimator", "other", "recorder"):
        bus.changed(service, True)
    found = [(service, type(answer)) for service, answer in next_answers(collector, 5)]
    assert found == [
        ("simulator", ConfigReply), ("simulator", WorldReply), ("estimator", ConfigReply), ("estimator", ModelReply),
        ("other", ConfigReply),
    ]  # fmt: skip
    assert set(bus.asked) == set(bus.replies)
    assert set(session_description.QUERIES.values()) == {CONFIG, WORLD, MODEL}


def test_restarted_service(bus, collect):
    bus.replies = {("simulator", "config"): config(1), ("simulator", "world"): WorldReply(world=HALL)}
    collector = collect()
    bus.changed("simulator", True)
    assert len(next_answers(collector, 2)) == 2
    for seed in (2, 1):
        bus.changed("simulator", False)
        bus.replies["simulator", "config"] = config(seed)
        bus.changed("simulator", True)
        assert next_answers(collector, 1) == [("simulator", config(seed))]  # the world is still the same


def test_silent_service(bus, collect):
    collector = collect()
    bus.changed("silent", True)
    assert wait_until(lambda: bus.count("silent", "config") >= 2, 10)
    bus.replies["silent", "config"] = config(1)
    assert next_answers(collector, 1)[0][0] == "silent"
    bus.replies.clear()
    bus.asked.clear()
    bus.changed("silent", True)
    assert wait_until(lambda: bus.count("silent", "config") >= session_description.MAX_ATTEMPTS, 10)
    bus.changed("other", True)  # once its attempts are over, no other query is pending
    assert wait_until(lambda: bus.count("other", "config") >= session_description.MAX_ATTEMPTS, 10)
    assert bus.count("silent", "config") == session_description.MAX_ATTEMPTS


def model_of(weights, *, ready=lambda: True):
    def answer(request):
        if not ready():
            return ModelReply(ok=False, reason="no scan has come yet")
        reply = MODEL_OF_HALL.model_copy(update={"size": len(weights), "sha256": str(hash(weights.tobytes()))})
        return reply.model_copy(update={"weights": weights}) if request.weights else reply

    return answer


def test_late_and_changed_model(bus, collect):
    scans = []
    bus.replies = {("estimator", "config"): config(1)}
    bus.replies["estimator", "model"] = model_of(WEIGHTS, ready=lambda: bool(scans))
    collector = collect()
    bus.changed("estimator", True)
    assert wait_until(lambda: bus.count("estimator", "model") > session_description.MAX_ATTEMPTS, 10)
    assert [type(answer) for _, answer in collector.new_replies()] == [ConfigReply]
    scans.append(1)
    ((_, first),) = next_answers(collector, 1)
    assert first.weights.tobytes() == WEIGHTS.tobytes()
    before = len(bus.asked)
    assert wait_until(lambda: len(bus.asked) > before + 3, 10)  # queried repeatedly, but
    assert list(collector.new_replies()) == []  # an unchanged reply is not stored twice
    bus.replies["estimator", "model"] = model_of(WEIGHTS[:5])
    ((_, second),) = next_answers(collector, 1)
    assert second.weights.tobytes() == WEIGHTS[:5].tobytes()


@pytest.mark.parametrize(
    ("wanted", "limit", "answers"),
    [(False, 300, True), (True, 299, True), (True, 300, False)],
    ids=["not wanted", "too large", "refused"],
)
def test_model_without_weights(bus, collect, monkeypatch, wanted, limit, answers):
    monkeypatch.setattr(session_description, "MAX_WEIGHTS_BYTES", limit)

    def answer(request):
        return model_of(WEIGHTS)(request) if answers or not request.weights else ModelReply(ok=False, reason="changed")

    bus.replies = {("estimator", "config"): config(1), ("estimator", "model"): answer}
    collector = collect(weights=wanted)
    bus.changed("estimator", True)
    _, (_, reply) = next_answers(collector, 2)
    assert (reply.size, len(reply.weights)) == (300, 0)
