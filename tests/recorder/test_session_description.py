"""Queries to services, their repetition, and the records made of the replies."""

from __future__ import annotations

import json
import threading

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from common.bus.bus import wait_until
from common.errors import UserError
from common.geometry.world import World
from common.log import logger
from common.messages.requests import ConfigReply, ModelReply, WorldReply
from common.messages.topics import CONFIG, MODEL, WORLD
from common.robot.base import Robot
from services.recorder import session_description as describing
from services.recorder.session_description import AttachmentRecord, DescriptionCollector, MetadataRecord, records_of
from tests.recorder.sessions import SCANNER
from tests.recorder.sessions import WORLD as HALL

WEIGHTS = np.frombuffer(b"\x00\x01\xff" * 100, np.uint8)
MODEL_OF_HALL = ModelReply(
    estimator="precise", world=HALL, card='{"a": 1}', file="hall-precise.safetensors", size=300, sha256="ab"
)


def stored(service, answer):
    """Metadata by name and attachments by name."""
    records = list(records_of(service, answer))
    metadata = {r.name: r.values for r in records if isinstance(r, MetadataRecord)}
    attachments = {r.name: r.data for r in records if isinstance(r, AttachmentRecord)}
    assert len(metadata) + len(attachments) == len(records)
    assert isinstance(records[-1], MetadataRecord)  # metadata follows the attachments that it refers to
    return metadata, attachments


def test_a_configuration_with_its_versions():
    reply = ConfigReply(service="x", config='{"seed": 1}', versions={"python": "3.11", "commit": "abc"})
    assert stored("x", reply) == ({"config:x": {"config": '{"seed": 1}', "python": "3.11", "commit": "abc"}}, {})


def test_a_world_with_scanner_and_robot():
    metadata, attachments = stored("simulator", WorldReply(world=HALL, scanner=SCANNER, robot=Robot(radius=0.3)))
    assert World.model_validate(yaml.safe_load(attachments["world.yaml"])) == HALL
    assert metadata["world"].keys() == {"scanner", "robot"}
    assert json.loads(metadata["world"]["scanner"])["beams"] == SCANNER.beams
    assert json.loads(metadata["world"]["robot"])["radius"] == 0.3


def test_a_model_with_its_weights():
    metadata, attachments = stored("estimator", MODEL_OF_HALL.model_copy(update={"weights": WEIGHTS}))
    assert metadata["model"] == {
        "estimator": "precise", "card": '{"a": 1}', "file": "hall-precise.safetensors",
        "size": "300", "sha256": "ab", "weights": "stored",
    }  # fmt: skip
    assert attachments["model/hall-precise.json"] == b'{"a": 1}'
    assert attachments["model/hall-precise.safetensors"] == WEIGHTS.tobytes()
    assert World.model_validate(yaml.safe_load(attachments["model/world.yaml"])) == HALL


def test_a_model_whose_weights_are_not_there_says_so():
    metadata, attachments = stored("estimator", MODEL_OF_HALL)
    assert metadata["model"]["weights"] == "not stored"
    assert metadata["model"]["sha256"] == "ab"
    assert attachments.keys() == {"model/hall-precise.json", "model/world.yaml"}
    metadata, attachments = stored("estimator", ModelReply(estimator="particle-filter", world=HALL))
    assert metadata["model"] == {
        "estimator": "particle-filter", "card": "", "file": "", "weights": "none: nothing was learned",
    }  # fmt: skip
    assert attachments.keys() == {"model/world.yaml"}


@given(st.text(st.characters(codec="utf-8"), max_size=30).map(lambda name: f"{name}.safetensors"))
def test_no_name_from_the_bus_leads_out_of_a_folder(name):
    _, attachments = stored("estimator", MODEL_OF_HALL.model_copy(update={"file": name, "weights": WEIGHTS}))
    for attachment in attachments:
        assert attachment.startswith("model/")
        assert "/" not in attachment.removeprefix("model/")
        assert "\\" not in attachment
        assert "\0" not in attachment


@pytest.mark.parametrize("name", ["../x.safetensors", "a/b.safetensors", "x.so", "/x.safetensors", "x.safetensors\n"])
def test_a_name_that_is_none_is_no_file(name):
    metadata, attachments = stored("estimator", MODEL_OF_HALL.model_copy(update={"file": name, "weights": WEIGHTS}))
    assert attachments.keys() == {"model/world.yaml"}
    assert metadata["model"]["file"] == ""
    assert metadata["model"]["weights"] == "not stored"


class FakeBus:
    """Simulates services that answer, or do not, and records all queries."""

    def __init__(self):
        self.asked, self.replies = [], {}
        self.changed = lambda service, there: None

    def watch_alive(self, changed):
        self.changed = changed

    def ask(self, query, request, reply, timeout, service="*"):
        self.asked.append((service if query.per_service else query.server, query.name))
        answer = self.replies.get(self.asked[-1])
        answer = answer(request) if callable(answer) else answer
        if answer is None:
            raise UserError(f"nobody answers {query.name}")
        assert type(answer) is reply
        return answer


@pytest.fixture
def bus():
    return FakeBus()


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    for name in ("RETRY_DELAY_S", "MODEL_RETRY_DELAY_S", "MODEL_RECHECK_PERIOD_S"):
        monkeypatch.setattr(describing, name, 0.01)


@pytest.fixture
def describe(bus):
    """Returns a function that creates a collector. All collectors are stopped after the test."""
    made = []

    def make(*, weights=True):
        made.append(DescriptionCollector(bus, "recorder", logger("test"), weights=weights))
        return made[-1]

    yield make
    for each in made:
        each.stop()
        each.join()
        assert not each._thread.is_alive()
    assert threading.active_count() < 20


def next_answers(describer, count):
    found = []

    def look():
        found.extend(describer.answers())
        return len(found) >= count

    assert wait_until(look, 10), found
    return found


def config(seed):
    return ConfigReply(service="simulator", config=json.dumps({"seed": seed}))


def test_each_service_is_asked_what_it_can_answer(bus, describe):
    bus.replies = {
        ("simulator", "config"): config(1),
        ("simulator", "world"): WorldReply(world=HALL),
        ("estimator", "config"): config(2),
        ("estimator", "model"): MODEL_OF_HALL,
        ("other", "config"): config(3),
    }
    describer = describe(weights=False)
    for service in ("simulator", "estimator", "other", "recorder"):
        bus.changed(service, True)
    found = next_answers(describer, 5)
    assert [(s, type(a)) for s, a in found] == [
        ("simulator", ConfigReply), ("simulator", WorldReply), ("estimator", ConfigReply), ("estimator", ModelReply),
        ("other", ConfigReply),
    ]  # fmt: skip
    assert set(bus.asked) == set(bus.replies)


def test_a_service_started_anew_with_another_configuration_is_stored_again(bus, describe):
    bus.replies = {("simulator", "config"): config(1), ("simulator", "world"): WorldReply(world=HALL)}
    describer = describe()
    bus.changed("simulator", True)
    assert len(next_answers(describer, 2)) == 2
    bus.changed("simulator", False)
    bus.replies["simulator", "config"] = config(2)
    bus.changed("simulator", True)
    assert next_answers(describer, 1) == [("simulator", config(2))]  # the world is still the same
    bus.changed("simulator", True)
    bus.replies["simulator", "config"] = config(1)
    bus.changed("simulator", True)
    assert next_answers(describer, 1) == [("simulator", config(1))]


def test_one_that_is_silent_is_asked_again_but_not_for_ever(bus, describe):
    describer = describe()
    bus.changed("mute", True)
    assert wait_until(lambda: bus.asked.count(("mute", "config")) >= 2, 10)
    bus.replies["mute", "config"] = config(1)
    assert next_answers(describer, 1)[0][0] == "mute"
    bus.replies.clear()
    bus.asked.clear()
    bus.changed("mute", True)
    assert wait_until(lambda: bus.asked.count(("mute", "config")) >= describing.MAX_ATTEMPTS, 10)
    bus.changed("other", True)  # once its attempts are over, no other query is pending
    assert wait_until(lambda: bus.asked.count(("other", "config")) >= describing.MAX_ATTEMPTS, 10)
    assert bus.asked.count(("mute", "config")) == describing.MAX_ATTEMPTS


def a_model(weights, *, ok=lambda: True):
    def answer(request):
        if not ok():
            return ModelReply(ok=False, reason="no scan has come yet")
        reply = MODEL_OF_HALL.model_copy(update={"size": len(weights), "sha256": str(hash(weights.tobytes()))})
        return reply.model_copy(update={"weights": weights}) if request.weights else reply

    return answer


def test_a_model_not_known_yet_is_waited_for_and_another_one_noticed(bus, describe):
    scans = []
    bus.replies = {("estimator", "config"): config(1), ("estimator", "model"): a_model(WEIGHTS, ok=lambda: bool(scans))}
    describer = describe()
    bus.changed("estimator", True)
    assert wait_until(lambda: bus.asked.count(("estimator", "model")) > describing.MAX_ATTEMPTS, 10)
    assert [type(a) for _, a in describer.answers()] == [ConfigReply]
    scans.append(1)
    ((_, first),) = next_answers(describer, 1)
    assert first.weights.tobytes() == WEIGHTS.tobytes()
    before = len(bus.asked)
    assert wait_until(lambda: len(bus.asked) > before + 3, 10)  # queried repeatedly, but
    assert list(describer.answers()) == []  # an unchanged reply is not stored twice
    bus.replies["estimator", "model"] = a_model(WEIGHTS[:5])
    ((_, second),) = next_answers(describer, 1)
    assert second.weights.tobytes() == WEIGHTS[:5].tobytes()
    bus.changed("estimator", False)


@pytest.mark.parametrize(("weights", "limit"), [(False, 1 << 20), (True, 299)])
def test_weights_that_are_not_wanted_or_too_large_are_not_asked_for(bus, describe, monkeypatch, weights, limit):
    monkeypatch.setattr(describing, "MAX_WEIGHTS_BYTES", limit)
    bus.replies = {("estimator", "config"): config(1), ("estimator", "model"): a_model(WEIGHTS)}
    describer = describe(weights=weights)
    bus.changed("estimator", True)
    _, (_, reply) = next_answers(describer, 2)
    assert reply.size == 300
    assert len(reply.weights) == 0


def test_weights_that_cannot_be_had_leave_what_can(bus, describe):
    def answer(request):
        return ModelReply(ok=False, reason="changed") if request.weights else MODEL_OF_HALL

    bus.replies = {("estimator", "config"): config(1), ("estimator", "model"): answer}
    describer = describe()
    bus.changed("estimator", True)
    _, (_, reply) = next_answers(describer, 2)
    assert reply == MODEL_OF_HALL


def test_every_question_is_a_row_of_the_table():
    assert set(describing.QUERIES.values()) == {CONFIG, WORLD, MODEL}
