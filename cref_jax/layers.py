"""The layers that the networks are made of, in the forms that are quick on a CPU, too.

Everything has the axes [T, E, ...]. Only the recurrent cells walk through time; every other layer
sees T * E samples at once.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, PRNGKeyArray


def dense(features: int, name: str, **settings: Any) -> nn.Dense:
    """Return a dense layer that knows the quicker gradient of its product."""
    return nn.Dense(features, dot_general=_dot_general, name=name, **settings)


class MLP(nn.Module):
    """Dense layers with ELU between them and none after the last.

    With a `scale`, the last layer starts as an orthogonal matrix times it.
    """

    widths: Sequence[int]
    scale: float | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "T E _"]) -> Float[Array, "T E _"]:
        """Return the last layer's output."""
        *hidden, last = self.widths
        for i, width in enumerate(hidden):
            x = nn.elu(dense(width, name=f"layer_{i}")(x))
        init = nn.linear.default_kernel_init
        if self.scale is not None:
            init = nn.initializers.orthogonal(self.scale)
        return dense(last, kernel_init=init, name=f"layer_{len(hidden)}")(x)


class Convolution(nn.Module):
    """A convolution whose output is the input's size over the stride, as one matrix product.

    The patches are gathered by strided slices: XLA's own convolution takes 1.6 times as long on a
    CPU. Padding is zero, and as equal on both sides as it can be.
    """

    channels: int
    kernel: int
    stride: int

    @nn.compact
    def __call__(self, x: Float[Array, "T E H W I"]) -> Float[Array, "T E h w O"]:
        """Return the filtered image; its sides must be whole multiples of the stride."""
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


class LSTM(nn.Module):
    """A long short-term memory, gates in the order input, forget, candidate, output.

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
        """Return (c, h) after the last step, and h of all steps."""
        inputs = dense(4 * self.hidden, name="input")(x)
        kernel = self.param("recurrent", _stacked_orthogonal, (self.hidden, 4 * self.hidden))

        def step(
            memory: tuple[Float[Array, "E H"], Float[Array, "E H"]],
            xs: tuple[Float[Array, "E G"], Bool[Array, " E"]],
        ) -> tuple[tuple[Float[Array, "E H"], Float[Array, "E H"]], Float[Array, "E H"]]:
            x, begin = xs
            c, h = (jnp.where(begin[:, None], 0.0, m) for m in memory)
            i, f, g, o = jnp.split(x + h @ kernel, 4, axis=-1)
            c = nn.sigmoid(f) * c + nn.sigmoid(i) * nn.tanh(g)
            h = nn.sigmoid(o) * nn.tanh(c)
            return (c, h), h

        return jax.lax.scan(step, memory, (inputs, begins))


class GRU(nn.Module):
    """A gated recurrent unit, gates in the order reset, update, candidate.

    r = sigmoid(W_r x + U_r h + b_r),  u = sigmoid(W_u x + U_u h + b_u)
    n = tanh(W_n x + b_n + r (U_n h + b_hn)),  h' = (1 - u) n + u h
    """

    hidden: int

    @nn.compact
    def __call__(
        self, memory: Float[Array, "E H"], x: Float[Array, "T E I"], begins: Bool[Array, "T E"]
    ) -> tuple[Float[Array, "E H"], Float[Array, "T E H"]]:
        """Return h after the last step, and h of all steps."""
        inputs = dense(3 * self.hidden, name="input")(x)
        kernel = self.param("recurrent", _stacked_orthogonal, (self.hidden, 3 * self.hidden))
        bias = self.param("candidate_bias", nn.initializers.zeros, (self.hidden,))

        def step(
            h: Float[Array, "E H"], xs: tuple[Float[Array, "E G"], Bool[Array, " E"]]
        ) -> tuple[Float[Array, "E H"], Float[Array, "E H"]]:
            x, begin = xs
            h = jnp.where(begin[:, None], 0.0, h)
            x_r, x_u, x_n = jnp.split(x, 3, axis=-1)
            h_r, h_u, h_n = jnp.split(h @ kernel, 3, axis=-1)
            update = nn.sigmoid(x_u + h_u)
            candidate = nn.tanh(x_n + nn.sigmoid(x_r + h_r) * (h_n + bias))
            h = (1.0 - update) * candidate + update * h
            return h, h

        return jax.lax.scan(step, memory, (inputs, begins))


def _dot_general(
    x: Float[Array, "*n I"], kernel: Float[Array, "I O"], dimensions: Any, precision: Any = None
) -> Float[Array, "*n O"]:
    """Return x W under the name and arguments by which nn.Dense asks for it."""
    del dimensions, precision
    return _product(x, kernel)


@jax.custom_vjp
def _product(x: Float[Array, "*n I"], kernel: Float[Array, "I O"]) -> Float[Array, "*n O"]:
    """Return x W.

    JAX writes the gradient of W as a transposed (g' x)', and a CPU then copies g to turn it over.
    Written as x' g it takes a fifth less time for the whole network, and gives the same numbers.
    """
    return x @ kernel


def _product_forward(
    x: Float[Array, "*n I"], kernel: Float[Array, "I O"]
) -> tuple[Float[Array, "*n O"], tuple[Float[Array, "*n I"], Float[Array, "I O"]]]:
    return x @ kernel, (x, kernel)


def _product_backward(
    seen: tuple[Float[Array, "*n I"], Float[Array, "I O"]], g: Float[Array, "*n O"]
) -> tuple[Float[Array, "*n I"], Float[Array, "I O"]]:
    x, kernel = seen
    flat_x, flat_g = x.reshape(-1, x.shape[-1]), g.reshape(-1, g.shape[-1])
    return g @ kernel.T, flat_x.T @ flat_g


_product.defvjp(_product_forward, _product_backward)


def _stacked_orthogonal(
    key: PRNGKeyArray, shape: tuple[int, int], dtype: jnp.dtype = jnp.float32
) -> Float[Array, "H G"]:
    """Return one orthogonal matrix for each gate, side by side."""
    hidden, gates = shape[0], shape[1] // shape[0]
    one = nn.initializers.orthogonal()
    return jnp.hstack([one(k, (hidden, hidden), dtype) for k in jax.random.split(key, gates)])
