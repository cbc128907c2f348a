"""The decoder's output and Jacobian in one forward pass.

A layer applies the same weights to a value and to its tangents, and the bias to the value only. A ReLU passes a tangent
where the value is positive (forward-mode differentiation; Griewank & Walther 2008, chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
from torch import nn

if TYPE_CHECKING:
    from common.geometry.se2 import Array

Step = Callable[["Array"], "Array"]


class ForwardMode:
    """Evaluates a network of linear layers, convolutions as in the decoder, unflattenings and ReLUs.

    Later changes of the network's weights have no effect.
    """

    def __init__(self, layers: Iterable[nn.Module]) -> None:
        """Copies the weights. Raises TypeError for layers of other types."""
        layers = list(layers)
        self._steps = [_step(layer) for layer in layers]
        self.dtype = next(p.detach().numpy().dtype for layer in layers for p in layer.parameters())

    def __call__(self, position: Array) -> tuple[Array, Array]:
        """Output (L,) of the last layer's only channel at ``position`` (2,), and its derivatives (2, L)."""
        rows = np.array([[position[0], 1, 0], [position[1], 0, 1]], self.dtype)[..., None]
        for step in self._steps:
            rows = step(rows)
        return rows[0, 0], rows[0, 1:]


def _step(layer: nn.Module) -> Step:
    """Function that applies a layer to (C, 3, L), the value and two tangents of each channel; it may change them."""
    if isinstance(layer, nn.ReLU):
        return _relu
    if isinstance(layer, nn.Unflatten):
        shape = layer.unflattened_size
        return lambda rows: np.asarray(rows[..., 0].reshape(*shape, 3).transpose(0, 2, 1))
    if isinstance(layer, nn.Linear | nn.Conv1d | nn.ConvTranspose1d):
        assert layer.bias is not None  # noqa: S101 - all layers of the decoder have a bias
        weight, bias = layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()
        if isinstance(layer, nn.Linear):
            return lambda rows: _apply(weight, bias, rows)
        if isinstance(layer, nn.ConvTranspose1d) and (weight.shape[2], layer.stride, layer.padding) == (4, (2,), (1,)):
            return _transposed_convolution(weight, bias)
        if isinstance(layer, nn.Conv1d) and layer.stride == (1,) and weight.shape[2] == 2 * int(layer.padding[0]) + 1:
            return _convolution(weight, bias)
    raise TypeError(f"no forward mode for {layer}")


def _relu(rows: Array) -> Array:
    rows *= rows[:, :1] > 0
    return rows


def _apply(weight: Array, bias: Array, rows: Array) -> Array:
    """Multiplies (C, 3, L) by ``weight`` (O, C), and adds ``bias`` to the values."""
    out = (weight @ rows.reshape(len(rows), -1)).reshape(len(weight), *rows.shape[1:])
    out[:, 0] += bias[:, None]
    return np.asarray(out)


def _convolution(weight: Array, bias: Array) -> Step:
    """A convolution of stride 1 that keeps the length, as one product with stacked shifted rows."""
    taps = weight.shape[2]
    flat = weight.transpose(0, 2, 1).reshape(len(weight), -1)

    def step(rows: Array) -> Array:
        stacked = np.empty((taps, *rows.shape), rows.dtype)
        for tap in range(taps):
            _shift(rows, tap - taps // 2, stacked[tap])
        return _apply(flat, bias, stacked.reshape(-1, *rows.shape[1:]))

    return step


def _transposed_convolution(weight: Array, bias: Array) -> Step:
    """A transposed convolution with 4 taps, stride 2 and padding 1.

    An even output depends on its input and the one before, an odd output on its input and the one after.
    """
    even = np.concatenate([weight[:, :, 1], weight[:, :, 3]]).T.copy()
    odd = np.concatenate([weight[:, :, 2], weight[:, :, 0]]).T.copy()

    def step(rows: Array) -> Array:
        channels, _, length = rows.shape
        out = np.empty((len(bias), 3, 2 * length), rows.dtype)
        stacked = np.empty((2 * channels, 3, length), rows.dtype)
        stacked[:channels] = rows
        _shift(rows, -1, stacked[channels:])
        out[..., 0::2] = _apply(even, bias, stacked)
        _shift(rows, 1, stacked[channels:])
        out[..., 1::2] = _apply(odd, bias, stacked)
        return out

    return step


def _shift(rows: Array, by: int, out: Array) -> None:
    """Fills ``out`` so that its entry l is entry l + ``by`` of ``rows``; zero beyond the ends."""
    if by > 0:
        out[..., :-by], out[..., -by:] = rows[..., by:], 0
    elif by < 0:
        out[..., -by:], out[..., :-by] = rows[..., :by], 0
    else:
        out[...] = rows
