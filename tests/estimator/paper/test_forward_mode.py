"""Values and derivatives compared with torch's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from services.estimator.paper.decoder import Decoder, DecoderShape
from services.estimator.paper.forward_mode import ForwardMode

UNIT = st.floats(-1, 1)


@given(seed=st.integers(0, 100), beams=st.integers(2, 90), channels=st.integers(1, 5), x=UNIT, y=UNIT)
def test_same_as_torch(seed, beams, channels, x, y):
    torch.manual_seed(seed)
    decoder = Decoder(DecoderShape(beams, hidden=7, channels=channels)).double()
    position = torch.tensor([x, y], dtype=torch.float64)
    ranges, tangents = ForwardMode(decoder.layers())(position.numpy())
    with torch.no_grad():
        expected = decoder(position[None])[0].numpy()
    derivative = torch.autograd.functional.jacobian(lambda p: decoder(p[None])[0], position).numpy()
    assert ranges[:beams] == pytest.approx(expected, abs=1e-12)
    assert pytest.approx(derivative, abs=1e-12) == tangents[:, :beams].T


def test_single_precision():
    decoder = Decoder(DecoderShape(33, hidden=7, channels=3))
    ranges, tangents = ForwardMode(decoder.layers())(np.zeros(2))
    assert ranges.dtype == tangents.dtype == np.float32


@pytest.mark.parametrize(
    "layer", [nn.Sigmoid(), nn.Conv1d(2, 2, 3), nn.Conv1d(2, 2, 3, stride=2, padding=1), nn.ConvTranspose1d(2, 2, 3)]
)
def test_unknown_layer(layer):
    with pytest.raises(TypeError, match=type(layer).__name__):
        ForwardMode([layer])
