"""The policy and the value function (Sec. II-B, Eq. 6-16).

Everything has the axes [T, E, ...]: a rollout calls the actor with T = 1 and carries the memory on
from step to step, training calls it once with the whole horizon. Only the recurrent cells walk
through time; every other layer sees T * E samples at once. Observations arrive normalised.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cref_jax import config

_HEAD_SCALE = 0.01  # of the last layer of the action head; assumed: the first actions are near zero


class Carry(NamedTuple):
    """What the actor remembers between two control steps."""

    lstm_c: Float[Array, "E H_lstm"]
    lstm_h: Float[Array, "E H_lstm"]
    gru: Float[Array, "E H_gru"]


class Output(NamedTuple):
    """What the actor says at each step."""

    mean: Float[Array, "T E J"]  # of the action distribution
    log_std: Float[Array, " J"]  # of the action distribution, the same in every state
    velocity: Float[Array, "T E 3"]  # m/s, estimate of the base's linear velocity, body frame
    gate: Float[Array, "T E D"]  # beta_t, Eq. 16: near 1 where the action leans on memory


def initial_carry(c: config.Network, num_envs: int) -> Carry:
    """Return the empty memory of an episode's start."""
    return Carry(
        lstm_c=jnp.zeros((num_envs, c.lstm)),
        lstm_h=jnp.zeros((num_envs, c.lstm)),
        gru=jnp.zeros((num_envs, c.gru)),
    )


class Actor(nn.Module):
    """The policy: proprioception to the action distribution.

    The velocity loss trains the estimator alone, since the tokenizer sees its output through
    stop_gradient (assumed: the paper only says that they are trained jointly).
    """

    c: config.Network
    num_actions: int

    @nn.compact
    def __call__(
        self, carry: Carry, obs: Float[Array, "T E O"], begins: Bool[Array, "T E"]
    ) -> tuple[Carry, Output]:
        """Return the memory after the last step, and the outputs of all steps.

        Args:
            carry: the memory before the first step.
            obs: o^p, normalised (Eq. 2).
            begins: the step is the first of an episode, so the memory is emptied before it.
        """
        lstm, velocity = VelocityEstimator(self.c.lstm, name="velocity_estimator")(
            (carry.lstm_c, carry.lstm_h), obs, begins
        )
        seen = jnp.concatenate([obs, jax.lax.stop_gradient(velocity)], axis=-1)
        # assumed: one hidden layer of the token's width
        x = MLP((self.c.token, self.c.token), name="tokenizer")(seen)
        f = GatedResidualFusion(name="fusion")(x)
        gru, y, gate = RecurrentFusion(self.c.gru, name="recurrent_fusion")(carry.gru, f, begins)
        mean = MLP((*self.c.actor, self.num_actions), scale=_HEAD_SCALE, name="action_head")(y)
        log_std = self.param(
            "log_std", nn.initializers.constant(math.log(self.c.initial_std)), (self.num_actions,)
        )
        return Carry(*lstm, gru), Output(mean, log_std, velocity, gate)


class Critic(nn.Module):
    """The value function on privileged observations (Eq. 3)."""

    c: config.Network

    @nn.compact
    def __call__(self, critic_obs: Float[Array, "T E S"]) -> Float[Array, "T E"]:
        """Return V(s_t) for the normalised s_t."""
        return MLP((*self.c.critic, 1), scale=1.0, name="value_head")(critic_obs)[..., 0]


class VelocityEstimator(nn.Module):
    """The base's linear velocity from proprioception, v_hat = W LSTM(o^p) + b (Eq. 7)."""

    hidden: int

    @nn.compact
    def __call__(
        self,
        memory: tuple[Float[Array, "E H"], Float[Array, "E H"]],
        x: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
    ) -> tuple[tuple[Float[Array, "E H"], Float[Array, "E H"]], Float[Array, "T E 3"]]:
        """Return the cell's (c, h) after the last step, and the velocities in m/s."""
        memory, h = LSTM(self.hidden, name="lstm")(memory, x, begins)
        return memory, _dense(3, name="velocity")(h)


class GatedResidualFusion(nn.Module):
    """A residual update whose channels are gated (GRF, Eq. 11-14).

        x~ = ELU(W_1 LN(x) + b_1),  [c; g] = W_2 x~ + b_2,  f = x + c * sigmoid(g)

    All of x, x~, c, g and f have the same width.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "T E D"]) -> Float[Array, "T E D"]:
        """Return f."""
        width = x.shape[-1]
        mixed = nn.elu(_dense(width, name="mix")(nn.LayerNorm(name="norm")(x)))
        content, gate = jnp.split(_dense(2 * width, name="content_gate")(mixed), 2, axis=-1)
        return x + content * nn.sigmoid(gate)


class RecurrentFusion(nn.Module):
    """A GRU's memory blended with the current feature by a highway gate (Eq. 15-16).

    h_t = GRU(f_t, h_{t-1}),  z_t = W_h h_t
    beta_t = sigmoid(W_beta [z_t; f_t] + b_beta)
    y_t = beta_t * z_t + (1 - beta_t) * f_t
    """

    hidden: int

    @nn.compact
    def __call__(
        self, memory: Float[Array, "E H"], f: Float[Array, "T E D"], begins: Bool[Array, "T E"]
    ) -> tuple[Float[Array, "E H"], Float[Array, "T E D"], Float[Array, "T E D"]]:
        """Return the memory after the last step, the fused feature y and the gate beta."""
        width = f.shape[-1]
        memory, h = GRU(self.hidden, name="gru")(memory, f, begins)
        z = _dense(width, use_bias=False, name="memory_out")(h)
        gate = nn.sigmoid(_dense(width, name="gate")(jnp.concatenate([z, f], axis=-1)))
        return memory, gate * z + (1.0 - gate) * f, gate


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
            x = nn.elu(_dense(width, name=f"layer_{i}")(x))
        init = nn.linear.default_kernel_init
        if self.scale is not None:
            init = nn.initializers.orthogonal(self.scale)
        return _dense(last, kernel_init=init, name=f"layer_{len(hidden)}")(x)


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
        inputs = _dense(4 * self.hidden, name="input")(x)
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
        inputs = _dense(3 * self.hidden, name="input")(x)
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


def _dense(features: int, name: str, **settings: Any) -> nn.Dense:
    """Return a dense layer that knows the quicker gradient of its product."""
    return nn.Dense(features, dot_general=_dot_general, name=name, **settings)


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
