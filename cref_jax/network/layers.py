"""The layers of the networks, in forms that are fast on a CPU as well.

All arrays have the axes [T, E, ...]. Only the recurrent cells iterate over time; every other layer
processes T * E samples at once.
"""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cref_jax.network import recurrent

HEAD_SCALE = 0.01  # of the action head's last layer; assumed: the first actions are near zero
_EPSILON = 1e-6  # added to the variance of a layer norm; assumed: Flax's default


def dense(features: int, name: str, **settings: Any) -> nn.Dense:
    """Create a dense layer with the faster gradient of `product`."""
    return nn.Dense(features, dot_general=_dot_general, name=name, **settings)


def floor_log_std(log_std: Float[Array, " J"], least: float) -> Float[Array, " J"]:
    """Raise the logarithm of each action's deviation to that of the least one, which may be 0."""
    return jnp.maximum(log_std, math.log(max(least, 1e-9)))


@jax.custom_vjp
def elu(x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Compute x where it is above 0, and e^x - 1 elsewhere.

    The derivative below 0 is y + 1, so that only the result is stored for the gradient and no
    exponential is computed twice.
    """
    return jnp.where(x > 0.0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


def _elu_forward(x: Float[Array, "*n"]) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    y = elu(x)
    return y, y


def _elu_backward(y: Float[Array, "*n"], g: Float[Array, "*n"]) -> tuple[Float[Array, "*n"]]:
    return (g * jnp.where(y > 0.0, 1.0, y + 1.0),)


elu.defvjp(_elu_forward, _elu_backward)


class MLP(nn.Module):
    """Dense layers with ELU between them and none after the last.

    With a `scale`, the last layer is initialised to an orthogonal matrix times it.
    """

    widths: Sequence[int]
    scale: float | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "T E _"]) -> Float[Array, "T E _"]:
        """Compute the last layer's output."""
        *hidden, last = self.widths
        for i, width in enumerate(hidden):
            x = elu(dense(width, name=f"layer_{i}")(x))
        init = nn.linear.default_kernel_init
        if self.scale is not None:
            init = nn.initializers.orthogonal(self.scale)
        return dense(last, kernel_init=init, name=f"layer_{len(hidden)}")(x)


class Convolution(nn.Module):
    """A convolution as one matrix product; its output has the input's size over the stride.

    The patches are gathered by strided slices: XLA's own convolution takes 1.6 times as long on a
    CPU. The input is zero-padded, as evenly on both sides as possible.
    """

    channels: int
    kernel: int
    stride: int

    @nn.compact
    def __call__(self, x: Float[Array, "T E H W I"]) -> Float[Array, "T E h w O"]:
        """Filter an image whose sides are multiples of the stride."""
        height, width = (side // self.stride for side in x.shape[2:4])
        before = (self.kernel - self.stride) // 2
        after = self.kernel - self.stride - before
        side = (max(before, 0), max(after, 0))
        x = jnp.pad(x, ((0, 0), (0, 0), side, side, (0, 0)))
        rows = lambda k: slice(k, k + self.stride * (height - 1) + 1, self.stride)
        columns = lambda k: slice(k, k + self.stride * (width - 1) + 1, self.stride)
        patches = [
            x[:, :, rows(i), columns(j)] for i in range(self.kernel) for j in range(self.kernel)
        ]
        return dense(self.channels, name="filter")(jnp.concatenate(patches, axis=-1))


class PatchFilter(nn.Module):
    """A convolution without overlap, as one product for all patches.

    Its parameters are those of `Convolution`. The outputs of `group` successive patches are
    concatenated, as the next filter reads them.
    """

    channels: int
    group: int = 1

    @nn.compact
    def __call__(self, x: Float[Array, "patches I"]) -> Float[Array, "groups gO"]:
        """Filter the patches."""
        kernel, bias = DenseParameters(self.channels, name="filter")(x.shape[-1])
        # a product, not a tile: XLA would gather each element of the bias by index, and such a loop
        # does not vectorise
        again = np.tile(np.eye(self.channels, dtype=np.float32), self.group)
        bias = jnp.matmul(bias, again, precision=jax.lax.Precision.HIGHEST)
        return product(x, kernel).reshape(-1, self.group * self.channels) + bias


class DenseParameters(nn.Module):
    """The parameters of a dense layer."""

    features: int

    @nn.compact
    def __call__(self, inputs: int) -> tuple[Float[Array, "I O"], Float[Array, " O"]]:
        """Create kernel and bias."""
        shape = inputs, self.features
        kernel = self.param("kernel", nn.linear.default_kernel_init, shape)
        return kernel, self.param("bias", nn.initializers.zeros, shape[1:])


class LayerNorm(nn.Module):
    """Normalisation of the last axis to mean 0 and variance 1, then scale and shift."""

    @nn.compact
    def __call__(self, x: Float[Array, "*n D"]) -> Float[Array, "*n D"]:
        """Normalise x."""
        shape = x.shape[-1:]
        scale = self.param("scale", nn.initializers.ones, shape)
        return _normalize(x, scale, self.param("bias", nn.initializers.zeros, shape))


@jax.custom_vjp
def _normalize(
    x: Float[Array, "*n D"], scale: Float[Array, " D"], bias: Float[Array, " D"]
) -> Float[Array, "*n D"]:
    """Compute (x - mean) / sqrt(variance + 1e-6) * scale + bias.

    Only x and two numbers per row are stored for the gradient, which reads x as few times as
    possible: a tokenizer's normalisation moves more memory than its products.
    """
    return _normalize_forward(x, scale, bias)[0]


def _normalize_forward(
    x: Float[Array, "*n D"], scale: Float[Array, " D"], bias: Float[Array, " D"]
) -> tuple[Float[Array, "*n D"], tuple[Array, Array, Array, Array]]:
    mean = x.mean(axis=-1, keepdims=True)
    variance = jnp.square(x).mean(axis=-1, keepdims=True) - jnp.square(mean)
    inverse = jax.lax.rsqrt(jnp.maximum(variance, 0.0) + _EPSILON)
    return (x - mean) * inverse * scale + bias, (x, mean, inverse, scale)


def _normalize_backward(
    residuals: tuple[Array, Array, Array, Array], g: Float[Array, "*n D"]
) -> tuple[Float[Array, "*n D"], Float[Array, " D"], Float[Array, " D"]]:
    x, mean, inverse, scale = residuals
    unit, scaled = (x - mean) * inverse, g * scale
    shift = scaled.mean(axis=-1, keepdims=True)
    stretch = (scaled * unit).mean(axis=-1, keepdims=True)
    rows = tuple(range(x.ndim - 1))
    return inverse * (scaled - shift - unit * stretch), (g * unit).sum(rows), g.sum(rows)


_normalize.defvjp(_normalize_forward, _normalize_backward)


class LSTM(nn.Module):
    """A long short-term memory, with gates in the order input, forget, candidate, output.

    [i; f; g; o] = W x_t + U h_{t-1} + b
    c_t = sigmoid(f) c_{t-1} + sigmoid(i) tanh(g),  h_t = sigmoid(o) tanh(c_t)
    """

    hidden: int

    @nn.compact
    def __call__(
        self,
        memory: tuple[Float[Array, "E H"], Float[Array, "E H"]],
        x: Float[Array, "T E I"],
        begins: Bool[Array, "T E"],
    ) -> tuple[tuple[Float[Array, "E H"], Float[Array, "E H"]], Float[Array, "T E H"]]:
        """Compute (c, h) after the last step, and h of all steps."""
        inputs = dense(4 * self.hidden, name="input")(x)
        kernel = self.param("recurrent", _stacked_orthogonal, (self.hidden, 4 * self.hidden))

        def cell(
            c: Float[Array, "E H"], h: Array, x: Array, gates: Float[Array, "E G"]
        ) -> tuple[Float[Array, "E H"], Float[Array, "E H"]]:
            i, f, g, o = jnp.split(gates, 4, axis=-1)
            c = nn.sigmoid(f) * c + nn.sigmoid(i) * nn.tanh(g)
            return c, nn.sigmoid(o) * nn.tanh(c)

        return recurrent.run(cell, memory, inputs[..., :0], inputs, kernel, begins)


class GRU(nn.Module):
    """A gated recurrent unit, with gates in the order reset, update, candidate.

    r = sigmoid(W_r x + U_r h + b_r),  u = sigmoid(W_u x + U_u h + b_u)
    n = tanh(W_n x + b_n + r (U_n h + b_hn)),  h' = (1 - u) n + u h
    """

    hidden: int

    @nn.compact
    def __call__(
        self, memory: Float[Array, "E H"], x: Float[Array, "T E I"], begins: Bool[Array, "T E"]
    ) -> tuple[Float[Array, "E H"], Float[Array, "T E H"]]:
        """Compute h after the last step, and h of all steps."""
        inputs = dense(3 * self.hidden, name="input")(x)
        kernel = self.param("recurrent", _stacked_orthogonal, (self.hidden, 3 * self.hidden))
        bias = self.param("candidate_bias", nn.initializers.zeros, (self.hidden,))

        def cell(
            _: None, h: Float[Array, "E H"], x_n: Float[Array, "E H"], gates: Float[Array, "E G"]
        ) -> tuple[None, Float[Array, "E H"]]:
            r, u, h_n = jnp.split(gates, 3, axis=-1)
            update = nn.sigmoid(u)
            candidate = nn.tanh(x_n + nn.sigmoid(r) * h_n)
            return None, (1.0 - update) * candidate + update * h

        gates, x_n = jnp.split(inputs, [2 * self.hidden], axis=-1)
        offset = jnp.concatenate([gates, jnp.broadcast_to(bias, x_n.shape)], axis=-1)
        (_, memory), h = recurrent.run(cell, (None, memory), x_n, offset, kernel, begins)
        return memory, h


def _dot_general(
    x: Float[Array, "*n I"], kernel: Float[Array, "I O"], dimensions: Any, precision: Any = None
) -> Float[Array, "*n O"]:
    """Compute x W, with the signature that nn.Dense expects."""
    del dimensions, precision
    return product(x, kernel)


@jax.custom_vjp
def product(x: Float[Array, "*n I"], kernel: Float[Array, "I O"]) -> Float[Array, "*n O"]:
    """Compute x W.

    JAX writes the gradient of W as a transposed (g' x)', for which a CPU copies g to transpose it.
    Written as x' g, the whole network takes a fifth less time, with the same numbers.
    """
    return x @ kernel


def _product_forward(
    x: Float[Array, "*n I"], kernel: Float[Array, "I O"]
) -> tuple[Float[Array, "*n O"], tuple[Float[Array, "*n I"], Float[Array, "I O"]]]:
    return x @ kernel, (x, kernel)


def _product_backward(
    inputs: tuple[Float[Array, "*n I"], Float[Array, "I O"]], g: Float[Array, "*n O"]
) -> tuple[Float[Array, "*n I"], Float[Array, "I O"]]:
    x, kernel = inputs
    flat_x, flat_g = x.reshape(-1, x.shape[-1]), g.reshape(-1, g.shape[-1])
    return g @ kernel.T, flat_x.T @ flat_g


product.defvjp(_product_forward, _product_backward)


def _stacked_orthogonal(
    key: PRNGKeyArray, shape: tuple[int, int], dtype: jnp.dtype = jnp.float32
) -> Float[Array, "H G"]:
    """Initialise one orthogonal matrix per gate, side by side."""
    hidden, gates = shape[0], shape[1] // shape[0]
    one = nn.initializers.orthogonal()
    return jnp.hstack([one(k, (hidden, hidden), dtype) for k in jax.random.split(key, gates)])
