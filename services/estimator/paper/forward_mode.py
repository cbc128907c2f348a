"""The decoder's output and Jacobian in one forward pass.

A layer maps value and tangents by the same weights, the value alone gets the bias, and a ReLU passes a tangent where
the value is positive (forward-mode differentiation; Griewank & Walther 2008, chapter 3).
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
    """Of a network of linear layers, convolutions as the decoder has them, unflattenings and ReLUs, as it is now."""

    def __init__(self, layers: Iterable[nn.Module]) -> None:
        """Copy the weights; raises TypeError for a layer that it does not know."""
        self._steps = [_step(layer) for layer in layers]

    def __call__(self, positions: Array) -> tuple[Array, Array]:
        """Output (N, L) of the last layer's only channel at ``positions`` (N, 2), and its derivatives (N, 2, L).

        Each position's numbers are the same to the bit, whoever goes with it.
        """
        rows = np.zeros((len(positions), 2, 3, 1), positions.dtype)
        rows[:, :, 0, 0], rows[:, :, 1:, 0] = positions, np.eye(2)
        for step in self._steps:
            rows = step(rows)
        return rows[:, 0, 0], rows[:, 0, 1:]


def _step(layer: nn.Module) -> Step:
    """From (N, C, 3, L), value and two tangents of each channel, to the same of the next layer."""
    if isinstance(layer, nn.ReLU):
        return lambda rows: np.asarray(rows * (rows[:, :, :1] > 0))
    if isinstance(layer, nn.Unflatten):
        channels, length = layer.unflattened_size
        return lambda rows: np.asarray(rows[..., 0].reshape(-1, channels, length, 3).transpose(0, 1, 3, 2))
    if isinstance(layer, nn.Linear | nn.Conv1d | nn.ConvTranspose1d):
        assert layer.bias is not None  # noqa: S101 - the decoder asks for none without
        weight, bias = layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()
        if isinstance(layer, nn.Linear):
            return lambda rows: _mapped(weight, bias, rows)
        if isinstance(layer, nn.ConvTranspose1d) and (weight.shape[2], layer.stride, layer.padding) == (4, (2,), (1,)):
            return _doubling(weight, bias)
        if isinstance(layer, nn.Conv1d) and layer.stride == (1,) and weight.shape[2] == 2 * int(layer.padding[0]) + 1:
            return _convolution(weight, bias)
    raise TypeError(f"no forward mode for {layer}")


def _mapped(weight: Array, bias: Array, rows: Array) -> Array:
    """(O, C) on (N, C, 3, L)."""
    count, channels, kinds, length = rows.shape
    # One product for each of the N: the library that multiplies rounds by the shapes of what it is given.
    out = (weight @ rows.reshape(count, channels, kinds * length)).reshape(count, len(weight), kinds, length)
    out[:, :, 0] += bias[:, None]
    return np.asarray(out)


def _convolution(weight: Array, bias: Array) -> Step:
    """Stride 1, as long as before: one product with the shifted rows below one another."""
    taps = weight.shape[2]
    flat = weight.transpose(0, 2, 1).reshape(len(weight), -1)
    return lambda rows: _mapped(
        flat, bias, np.concatenate([_shifted(rows, k - taps // 2) for k in range(taps)], axis=1)
    )


def _doubling(weight: Array, bias: Array) -> Step:
    """Transposed, 4 taps, stride 2, padding 1: even places see this one and the one before, odd ones the one after."""
    even = np.concatenate([weight[:, :, 1], weight[:, :, 3]]).T.copy()
    odd = np.concatenate([weight[:, :, 2], weight[:, :, 0]]).T.copy()

    def step(rows: Array) -> Array:
        out = np.empty((len(rows), len(bias), rows.shape[2], 2 * rows.shape[3]), rows.dtype)
        out[..., 0::2] = _mapped(even, bias, np.concatenate([rows, _shifted(rows, -1)], axis=1))
        out[..., 1::2] = _mapped(odd, bias, np.concatenate([rows, _shifted(rows, 1)], axis=1))
        return out

    return step


def _shifted(rows: Array, by: int) -> Array:
    """Entry l is the old l + ``by``; zero beyond the ends."""
    if by == 0:
        return rows
    out = np.zeros_like(rows)
    if by > 0:
        out[..., :-by] = rows[..., by:]
    else:
        out[..., -by:] = rows[..., :by]
    return out
