"""The paper's network: its shape, its Jacobian, its learning."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from common.errors import UserError
from services.estimator.paper.decoder import Decoder, DecoderShape, PaperModel
from services.estimator.paper.estimator import PaperGenerativeModel
from services.estimator.paper.training import Trainer, TrainingParameters, usable_ranges
from tests.estimator.models import HEADING, SCANNER
from tests.estimator.paper.training_scans import normalisation, posed_scans

TRAIN, TEST = posed_scans(400, 1), posed_scans(100, 2)
SHAPE = DecoderShape(64, hidden=32, channels=4)
PARAMETERS = TrainingParameters(epochs=4, batch=50, learning_rate=5e-3)


def trainer() -> Trainer:
    return Trainer(SHAPE, normalisation(), PARAMETERS, TRAIN, TEST)


@pytest.mark.parametrize("beams", [2, 64, 181, 622, 811])
def test_number_of_beams(beams):
    torch.manual_seed(0)
    assert Decoder(DecoderShape(beams))(torch.zeros(3, 2)).shape == (3, beams)


@given(st.floats(0.5, 5.5), st.floats(0.5, 3.5))
def test_jacobian(x, y):
    torch.manual_seed(3)
    model = PaperModel(Decoder(SHAPE).double(), normalisation())
    pose = np.array([x, y, np.pi / 2])
    ranges, jacobian = model.predict(pose)
    assert np.allclose(ranges, model.ranges(pose[None])[0])
    h = 1e-7  # so small that nearly no pose is at the kink of a ReLU
    for axis in range(2):
        step = h * np.eye(3)[axis]
        numeric = (model.ranges((pose + step)[None]) - model.ranges((pose - step)[None]))[0] / (2 * h)
        assert np.median(np.abs(jacobian[:, axis] - numeric)) < 1e-6
        assert np.mean(np.abs(jacobian[:, axis] - numeric) < 1e-5) > 0.9
    assert not jacobian[:, 2].any()  # the heading is constant


def test_learning():
    one = Trainer(
        DecoderShape(64, 64, 8),
        normalisation(),
        TrainingParameters(epochs=40, batch=50, learning_rate=5e-3),
        TRAIN,
        TEST,
    )
    one.run()
    flat = np.abs(TEST.ranges - np.median(TRAIN.ranges, axis=0)).mean()  # error of a constant prediction
    assert one.progress.test_l1[-1] < 0.8 * flat
    assert one.progress.test_l1[-1] < one.progress.test_l1[0]


def test_seed():
    a, b = trainer().run(), trainer().run()
    other = Trainer(
        SHAPE, normalisation(), TrainingParameters(epochs=4, batch=50, learning_rate=5e-3, seed=1), TRAIN, TEST
    ).run()
    assert np.array_equal(a.ranges(TEST.poses), b.ranges(TEST.poses))
    assert not np.array_equal(a.ranges(TEST.poses), other.ranges(TEST.poses))


def test_usable_ranges():
    assert usable_ranges(np.array([np.inf, -np.inf, 3.0, 30.0]), 25.0).tolist() == [25.0, 0.0, 3.0, 25.0]


def test_decoder_as_a_generative_model():
    torch.manual_seed(0)
    model = PaperModel(Decoder(DecoderShape(SCANNER.beams, 16, 4)).double(), normalisation())
    scans = PaperGenerativeModel(model, SCANNER, HEADING, 0.3)
    laser = np.array([[2.0, 1.5, HEADING + 1.0]])  # the heading is ignored, because the decoder is trained for one only
    expected = scans.expect(laser, SCANNER.angles())
    base = np.array([2.0, 1.5, 0.0]) - [*(np.array([np.cos(HEADING + 1), np.sin(HEADING + 1)]) * SCANNER.mount[0]), 0]
    ranges, jacobian = model.predict(np.array([*base[:2], HEADING]))
    assert expected.ranges[0] == pytest.approx(ranges)
    assert expected.jacobian[0] == pytest.approx(jacobian)
    assert (expected.scale == 0.3).all()
    assert np.array_equal(scans.expect(laser, SCANNER.angles()[::2]).ranges[0], ranges[::2])
    with pytest.raises(UserError, match="beams of its training"):
        scans.expect(laser, np.array([3.0]))
