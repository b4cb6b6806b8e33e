"""Layers in numpy: buffers are allocated once, and every product is a matrix product."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cref_jax.runtime.tables import PolicyFormatError, Table, Weights


class Gru:
    """A gated recurrent unit (Eq. 15), with gates in the order reset, update, candidate."""

    def __init__(self, weights: Weights, width: int, hidden: int) -> None:
        self._input = Dense(weights, "input", width, 3 * hidden)
        self._recurrent = weights.take("recurrent", hidden, 3 * hidden)
        self._bias = weights.take("candidate_bias", hidden)
        self._gates = np.zeros(3 * hidden, np.float32)
        self.h = np.zeros(hidden, np.float32)

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """Compute h [H] of f [D]."""
        n, x, gates = len(self.h), self._input(f), self._gates
        np.dot(self.h, self._recurrent, out=gates)
        gates[: 2 * n] += x[: 2 * n]
        reset, update = sigmoid(gates[:n]), sigmoid(gates[n : 2 * n])
        candidate = gates[2 * n :]
        candidate += self._bias
        candidate *= reset
        candidate += x[2 * n :]
        np.tanh(candidate, out=candidate)
        self.h -= candidate
        self.h *= update
        self.h += candidate  # (1 - u) n + u h
        return self.h


class Mlp:
    """Dense layers with ELU between them."""

    def __init__(self, weights: Weights, widths: Sequence[int]) -> None:
        self._layers = [
            Dense(weights, f"layer_{i}", a, b, elu=i < len(widths) - 2)
            for i, (a, b) in enumerate(zip(widths, widths[1:]))
        ]
        self.out = self._layers[-1].out

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the last layer's output."""
        for layer in self._layers:
            x = layer(x)
        return x


class Dense:
    """x W + b, then optionally ELU, in a buffer that the next call overwrites."""

    def __init__(
        self,
        weights: Weights,
        name: str,
        inputs: int,
        outputs: int,
        rows: int = 0,
        bias: bool = True,
        elu: bool = False,
    ) -> None:
        self._kernel = weights.take(name + "/kernel", inputs, outputs)
        self._bias = weights.take(name + "/bias", outputs) if bias else None
        self.out = np.zeros((rows, outputs) if rows else outputs, np.float32)
        self._below = np.zeros_like(self.out) if elu else None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the output of x [inputs] or [rows, inputs]."""
        np.dot(x, self._kernel, out=self.out)
        if self._bias is not None:
            self.out += self._bias
        if self._below is not None:
            np.minimum(self.out, 0.0, out=self._below)
            np.expm1(self._below, out=self._below)
            np.maximum(self.out, 0.0, out=self.out)
            self.out += self._below
        return self.out


class Norm:
    """Layer normalisation over the last axis."""

    def __init__(self, weights: Weights, width: int) -> None:
        self._scale = weights.take("norm/scale", width)
        self._bias = weights.take("norm/bias", width)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Normalise x."""
        centred = x - x.mean(axis=-1, keepdims=True)
        variance = np.mean(centred * centred, axis=-1, keepdims=True)
        centred *= self._scale / np.sqrt(variance + np.float32(1e-6))
        centred += self._bias
        return centred


def read_convolutions(net: Table, shape: tuple[int, int]) -> list[tuple[int, ...]]:
    """Read channels, kernel and stride of each layer of the depth tokenizer."""
    rows, columns = shape
    layers = []
    for i, layer in enumerate(net.tables("convolutions")):
        settings = tuple(layer.whole(key, 1, 1024) for key in ("channels", "kernel", "stride"))
        if rows % settings[2] or columns % settings[2]:
            raise PolicyFormatError(f"layer {i} does not divide an image of {shape}")
        rows, columns = rows // settings[2], columns // settings[2]
        layers.append(settings)
    if shape[0] % 8 or shape[1] % 8:
        raise PolicyFormatError(f"an image of {shape} has no blocks of 8 x 8")
    return layers


def sigmoid(x: np.ndarray) -> np.ndarray:
    """Compute 1 / (1 + exp(-x)) in place."""
    np.negative(x, out=x)
    np.minimum(x, 80.0, out=x)  # keeps exp from overflowing; the result is below 2e-35 either way
    np.exp(x, out=x)
    x += 1.0
    return np.reciprocal(x, out=x)
