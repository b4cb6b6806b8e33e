"""The network of Humanoid Parkour Learning's student in numpy."""

from __future__ import annotations

import numpy as np

from cref_jax.runtime.layers import Dense, Gru, Mlp, read_convolutions
from cref_jax.runtime.tables import PolicyFormatError, Table, Weights


class DepthLatent:
    """The latent of one frame: filters, each pooled by its stride, then dense layers."""

    def __init__(self, net: Table, weights: Weights, shape: tuple[int, int]) -> None:
        encoder, size = weights.under("depth_encoder"), (*shape, 1)
        self._layers = []
        for i, settings in enumerate(read_convolutions(net, shape)):
            self._layers.append(_PooledFilter(encoder.under(f"layer_{i}"), size, *settings))
            size = self._layers[-1].shape
        widths = *net.wholes("depth_mlp", 1, 8192), net.whole("compressed", 1, 4096)
        self._latent = Mlp(encoder.under("latent"), (size[0] * size[1] * size[2], *widths))

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray]:
        """Compute the latent [C] of D [H, W]."""
        x = image[..., None]
        for layer in self._layers:
            x = layer(x)
        return (self._latent(x.reshape(-1)),)


class ParkourActor:
    """The recurrent part, at 50 Hz: from the observation and the latent to the action."""

    def __init__(self, net: Table, weights: Weights, size: int, actions: int) -> None:
        inputs = size + net.whole("compressed", 1, 4096)
        hidden = net.whole("gru", 1, 4096)
        self._gru = Gru(weights.under("gru"), inputs, hidden)
        head = net.wholes("actor", 1, 8192)
        self._head = Mlp(weights.under("action_head"), (hidden, *head, actions))
        weights.take("log_std", actions)  # needed only to continue training
        self._inputs, self._size = np.zeros(inputs, np.float32), size
        self._gate = np.ones(hidden, np.float32)  # the action is decoded from memory alone

    def reset(self) -> None:
        """Clear the memory; the latent is zero until the next frame."""
        self._gru.h[:], self._inputs[:] = 0.0, 0.0

    def look(self, latent: np.ndarray) -> None:
        """Store the latent of a frame."""
        self._inputs[self._size :] = latent

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Compute the action [J] and update the memory."""
        self._inputs[: self._size] = obs
        return self._head(self._gru(self._inputs))

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the tensors after the last step, without copying them."""
        latent = self._inputs[self._size :]
        said = {"gru": self._gru.h, "gate": self._gate, "action": self._head.out}
        return {"compressed": latent, **said}


class _PooledFilter:
    """A convolution without padding, the largest of each block of pool x pool, then ELU."""

    def __init__(
        self,
        weights: Weights,
        shape: tuple[int, int, int],
        channels: int,
        kernel: int,
        pool: int,
    ) -> None:
        rows, columns, depth = shape
        self._kernel, self._pool = kernel, pool
        self._size = rows - kernel + 1, columns - kernel + 1
        self.shape = self._size[0] // pool, self._size[1] // pool, channels
        if min(self.shape) < 1:
            raise PolicyFormatError(f"a filter of {kernel} and {pool} leaves nothing of {shape}")
        count, inputs = self._size[0] * self._size[1], kernel * kernel * depth
        self._patches = np.zeros((count, inputs), np.float32)
        self._filter = Dense(weights, "filter", inputs, channels, count)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Compute the filtered image [h, w, channels] of [H, W, depth]."""
        side, pool, (rows, columns, channels) = self._kernel, self._pool, self.shape
        near = np.lib.stride_tricks.sliding_window_view(image, (side, side), axis=(0, 1))
        near = near.transpose(0, 1, 3, 4, 2)
        self._patches.reshape(near.shape)[:] = near
        y = self._filter(self._patches).reshape(*self._size, channels)
        y = y[: rows * pool, : columns * pool].reshape(rows, pool, columns, pool, channels)
        y = y.max(axis=(1, 3))
        return np.maximum(y, 0.0) + np.expm1(np.minimum(y, 0.0))
