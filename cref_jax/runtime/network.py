"""The network in numpy: buffers are allocated once, and every product is a matrix product."""

from __future__ import annotations

import numpy as np

from cref_jax.runtime.layers import Dense, Gru, Mlp, Norm, read_convolutions, sigmoid
from cref_jax.runtime.tables import PolicyFormatError, Table, Weights

VARIANTS = ("full", "no_cross_attention", "no_grf", "no_highway", "blind", "hpl")


class Encoder:
    """Depth tokens and compressed depth of one frame (Eq. 6-8)."""

    def __init__(self, net: Table, weights: Weights, shape: tuple[int, int]) -> None:
        tokenizer = weights.under("depth_tokenizer")
        rows, columns = shape
        self._layers, channels = [], 1
        for i, settings in enumerate(read_convolutions(net, shape)):
            weights_i = tokenizer.under(f"layer_{i}")
            self._layers.append(_Convolution(weights_i, (rows, columns, channels), *settings))
            rows, columns, channels = self._layers[-1].shape
        width = net.whole("token", 1, 4096)
        self._projection = Dense(tokenizer, "projection", channels, width, rows * columns)
        self._place = tokenizer.take("place", rows * columns, width)
        self._norm = Norm(tokenizer, width)
        self._blocks = (shape[0] // 8, 8, shape[1] // 8, 8)
        blocks, out = self._blocks[0] * self._blocks[2], net.whole("compressed", 1, 4096)
        self._compression = Dense(weights, "depth_compression/layer_0", blocks, out, elu=True)

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the tokens [N, D] and the compressed depth [C] of D [H, W]."""
        x = image[..., None]
        for layer in self._layers:
            x = layer(x)
        x = self._projection(x.reshape(-1, x.shape[-1]))
        x += self._place
        means = image.reshape(self._blocks).mean(axis=(1, 3)).reshape(-1)
        return self._norm(x), self._compression(means)


class Actor:
    """The recurrent part, at 50 Hz: from the observation and the current frame to the action."""

    def __init__(
        self, net: Table, weights: Weights, shape: tuple[int, int], size: int, actions: int
    ) -> None:
        variant, width = net.text("variant", VARIANTS), net.whole("token", 1, 4096)
        self._sees = variant != "blind"
        compressed = net.whole("compressed", 1, 4096) if self._sees else 0
        shrink = [stride for _, _, stride in read_convolutions(net, shape)] if self._sees else []
        tokens = int(np.prod(shape) // np.prod(shrink) ** 2) if self._sees else 0
        self._tokens = np.zeros((tokens, width), np.float32)
        self._query: _Attention | _Pooled | None = None
        if variant == "no_cross_attention":
            self._query = _Pooled(weights.under("pooled_tokens"), width)
        elif self._sees:
            heads = net.whole("heads", 1, 64)
            self._query = _Attention(weights.under("cross_attention"), width, heads, tokens)
        hidden = net.whole("lstm", 1, 4096)
        self._lstm = _Lstm(weights.under("velocity_estimator"), size + compressed, hidden)
        known = size + 3, width, width
        self._tokenizer = Mlp(weights.under("proprioceptive_tokenizer"), known)
        fused = 2 * width if self._sees else width
        self._fusion = _Fusion(weights.under("fusion"), fused, gated=variant != "no_grf")
        hidden, highway = net.whole("gru", 1, 4096), variant != "no_highway"
        self._memory = _Memory(weights.under("recurrent_fusion"), fused, hidden, highway)
        head = net.wholes("actor", 1, 8192)
        self._head = Mlp(weights.under("action_head"), (fused, *head, actions))
        weights.take("log_std", actions)  # needed only to continue training
        self._inputs = np.zeros(size + compressed, np.float32)
        self._known = np.zeros(size + 3, np.float32)
        self._x = np.zeros(fused, np.float32)
        self._size, self._width, self._seen = size, width, False

    def reset(self) -> None:
        """Clear the memories; everything derived from a frame is zero until the next one."""
        self._lstm.c[:], self._lstm.h[:], self._memory.h[:] = 0.0, 0.0, 0.0
        self._tokens[:], self._inputs[:], self._x[:] = 0.0, 0.0, 0.0
        if isinstance(self._query, _Attention):
            self._query.weights[:] = 0.0
        self._seen = False

    def look(self, tokens: np.ndarray, compressed: np.ndarray) -> None:
        """Store the encoding of a frame."""
        self._tokens[:], self._inputs[self._size :] = tokens, compressed
        self._seen = True

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Compute the action [J] and update the memory."""
        self._inputs[: self._size], self._known[: self._size] = obs, obs
        self._known[self._size :] = self._lstm(self._inputs)
        state = self._tokenizer(self._known)
        self._x[: self._width] = state
        if self._query is not None and self._seen:
            self._x[self._width :] = self._query(state, self._tokens)
        return self._head(self._memory(self._fusion(self._x)))

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the tensors after the last step, without copying them."""
        tensors = {
            "velocity": self._known[self._size :],
            "state_token": self._x[: self._width],
            "fused": self._fusion.out,
            "lstm_c": self._lstm.c,
            "lstm_h": self._lstm.h,
            "gru": self._memory.h,
            "gate": self._memory.gate,
            "blended": self._memory.out,
            "action": self._head.out,
        }
        if self._query is not None:
            tensors["tokens"], tensors["compressed"] = self._tokens, self._inputs[self._size :]
            tensors["depth_token"] = self._x[self._width :]
            if isinstance(self._query, _Attention):
                tensors["attention"] = self._query.weights
        return tensors


class _Attention:
    """Cross attention: the robot's state queries the depth tokens (Eq. 8-10)."""

    def __init__(self, weights: Weights, width: int, heads: int, tokens: int) -> None:
        if width % heads:
            raise PolicyFormatError(f"{heads} heads do not divide a width of {width}")
        each = width // heads
        self._norm = Norm(weights, width)
        self._query = Dense(weights, "query", width, width, bias=False)
        by_head = (width, heads, each)
        self._key = _copy(weights.take("key", width, width).reshape(by_head), (1, 2, 0))
        self._value = _copy(weights.take("value", width, width).reshape(by_head), (1, 0, 2))
        self._output = Dense(weights, "output", width, width, bias=False)
        self._shape, self._root = (heads, 1, each), np.float32(np.sqrt(each))
        self.weights = np.zeros((heads, tokens), np.float32)

    def __call__(self, state: np.ndarray, tokens: np.ndarray) -> np.ndarray:
        """Compute e^d [D] from the state [D] and the tokens [N, D]."""
        query = self._query(self._norm(state)).reshape(self._shape)
        query_key = np.matmul(query, self._key)[:, 0]
        weights = np.dot(query_key, tokens.T, out=self.weights)
        weights /= self._root
        weights -= weights.max(axis=1, keepdims=True)
        np.exp(weights, out=weights)
        weights /= weights.sum(axis=1, keepdims=True)
        mixed = weights.dot(tokens)
        return self._output(np.matmul(mixed[:, None], self._value).reshape(-1))


class _Pooled:
    """The ablation of cross attention: the mean of the tokens."""

    def __init__(self, weights: Weights, width: int) -> None:
        self._projection = Dense(weights, "projection", width, width)

    def __call__(self, state: np.ndarray, tokens: np.ndarray) -> np.ndarray:
        """Compute the projected mean [D]; the state is not used."""
        return self._projection(tokens.mean(axis=0))


class _Lstm:
    """The base's linear velocity (Eq. 7); gates in the order input, forget, candidate, output."""

    def __init__(self, weights: Weights, inputs: int, hidden: int) -> None:
        self._input = Dense(weights, "lstm/input", inputs, 4 * hidden)
        self._recurrent = weights.take("lstm/recurrent", hidden, 4 * hidden)
        self._velocity = Dense(weights, "velocity", hidden, 3)
        self._gates = np.zeros(4 * hidden, np.float32)
        self.c, self.h = np.zeros(hidden, np.float32), np.zeros(hidden, np.float32)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the velocity, m/s [3]."""
        gates, n = self._gates, len(self.c)
        np.dot(self.h, self._recurrent, out=gates)
        gates += self._input(x)
        candidate = np.tanh(gates[2 * n : 3 * n])
        sigmoid(gates)
        self.c *= gates[n : 2 * n]
        self.c += gates[:n] * candidate
        np.tanh(self.c, out=self.h)
        self.h *= gates[3 * n :]
        return self._velocity(self.h)


class _Fusion:
    """Gated residual fusion (Eq. 11-14)."""

    def __init__(self, weights: Weights, width: int, gated: bool) -> None:
        self._norm = Norm(weights, width)
        self._mix = Dense(weights, "mix", width, width, elu=True)
        name, outputs = ("content_gate", 2 * width) if gated else ("content", width)
        self._content = Dense(weights, name, width, outputs)
        self._gated, self.out = gated, np.zeros(width, np.float32)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute f [D] of x [D]."""
        content = self._content(self._mix(self._norm(x)))
        if self._gated:
            content, gate = content[: len(x)], content[len(x) :]
            content *= sigmoid(gate)
        return np.add(x, content, out=self.out)


class _Memory:
    """Recurrent fusion with a highway gate (Eq. 15-16)."""

    def __init__(self, weights: Weights, width: int, hidden: int, highway: bool) -> None:
        self._gru = Gru(weights.under("gru"), width, hidden)
        self._out = Dense(weights, "memory_out", hidden, width, bias=False)
        self._gate = Dense(weights, "gate", 2 * width, width) if highway else None
        self._both = np.zeros(2 * width, np.float32)
        self.h, self.out = self._gru.h, np.zeros(width, np.float32)
        self.gate = np.ones(width, np.float32)

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """Compute y [D] of f [D] and update the memory."""
        z = self._out(self._gru(f))
        if self._gate is None:
            self.out[:] = z
            return self.out
        self._both[: len(f)], self._both[len(f) :] = z, f
        self.gate = sigmoid(self._gate(self._both))
        np.subtract(z, f, out=self.out)
        self.out *= self.gate
        self.out += f  # b z + (1 - b) f
        return self.out


class _Convolution:
    """A convolution as one matrix product of gathered patches, then ELU; padding as in training."""

    def __init__(
        self,
        weights: Weights,
        shape: tuple[int, int, int],
        channels: int,
        kernel: int,
        stride: int,
    ) -> None:
        rows, columns, depth = shape
        before = max((kernel - stride) // 2, 0)
        sides = [side + max(kernel - stride, 0) for side in (rows, columns)]
        padded = np.zeros((*sides, depth), np.float32)
        self._inside = padded[before : before + rows, before : before + columns]
        self.shape = rows // stride, columns // stride, channels
        down, across, deep = padded.strides
        self._windows = np.lib.stride_tricks.as_strided(
            padded,
            (*self.shape[:2], kernel, kernel, depth),
            (stride * down, stride * across, down, across, deep),
        )
        count, size = self.shape[0] * self.shape[1], kernel * kernel * depth
        self._patches = np.zeros((count, size), np.float32)
        self._filter = Dense(weights, "filter", size, channels, count, elu=True)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Compute the filtered image [h, w, channels] of [H, W, depth]."""
        self._inside[:] = image
        self._patches.reshape(self._windows.shape)[:] = self._windows
        return self._filter(self._patches).reshape(self.shape)


def _copy(x: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Copy x with its axes permuted, contiguous in memory."""
    return np.ascontiguousarray(x.transpose(axes))
