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
        self._steps = [_step(layer) for layer in layers]

    def __call__(self, positions: Array) -> tuple[Array, Array]:
        """Output (N, L) of the last layer's only channel at ``positions`` (N, 2), and its derivatives (N, 2, L).

        The numbers of a position do not depend, to the bit, on the other positions of the call.
        """
        rows = np.zeros((len(positions), 2, 3, 1), positions.dtype)
        rows[:, :, 0, 0], rows[:, :, 1:, 0] = positions, np.eye(2)
        for step in self._steps:
            rows = step(rows)
        return rows[:, 0, 0], rows[:, 0, 1:]


def _step(layer: nn.Module) -> Step:
    """Function that applies a layer to (N, C, 3, L), the value and two tangents of each channel."""
    if isinstance(layer, nn.ReLU):
        return lambda rows: np.asarray(rows * (rows[:, :, :1] > 0))
    if isinstance(layer, nn.Unflatten):
        channels, length = layer.unflattened_size
        return lambda rows: np.asarray(rows[..., 0].reshape(-1, channels, length, 3).transpose(0, 1, 3, 2))
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


def _apply(weight: Array, bias: Array, rows: Array) -> Array:
    """Multiplies (N, C, 3, L) by ``weight`` (O, C), and adds ``bias`` to the values."""
    count, channels, kinds, length = rows.shape
    # One product for each of the N, because rounding in the matrix library depends on the shapes.
    out = (weight @ rows.reshape(count, channels, kinds * length)).reshape(count, len(weight), kinds, length)
    out[:, :, 0] += bias[:, None]
    return np.asarray(out)


def _convolution(weight: Array, bias: Array) -> Step:
    """A convolution of stride 1 that keeps the length, as one product with stacked shifted rows."""
    taps = weight.shape[2]
    flat = weight.transpose(0, 2, 1).reshape(len(weight), -1)
    return lambda rows: _apply(flat, bias, np.concatenate([_shifted(rows, k - taps // 2) for k in range(taps)], axis=1))


def _transposed_convolution(weight: Array, bias: Array) -> Step:
    """A transposed convolution with 4 taps, stride 2 and padding 1.

    An even output depends on its input and the one before, an odd output on its input and the one after.
    """
    even = np.concatenate([weight[:, :, 1], weight[:, :, 3]]).T.copy()
    odd = np.concatenate([weight[:, :, 2], weight[:, :, 0]]).T.copy()

    def step(rows: Array) -> Array:
        out = np.empty((len(rows), len(bias), rows.shape[2], 2 * rows.shape[3]), rows.dtype)
        out[..., 0::2] = _apply(even, bias, np.concatenate([rows, _shifted(rows, -1)], axis=1))
        out[..., 1::2] = _apply(odd, bias, np.concatenate([rows, _shifted(rows, 1)], axis=1))
        return out

    return step


def _shifted(rows: Array, by: int) -> Array:
    """Shifts entries, so that entry l becomes the former entry l + ``by``; zero beyond the ends."""
    if by == 0:
        return rows
    out = np.zeros_like(rows)
    if by > 0:
        out[..., :-by] = rows[..., by:]
    else:
        out[..., -by:] = rows[..., :by]
    return out
