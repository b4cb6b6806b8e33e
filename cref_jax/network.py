"""The policy and the value function (Sec. II-B, Eq. 6-16).

Everything has the axes [T, E, ...]: a rollout calls the actor with T = 1 and carries the memory on
from step to step, training calls it once with the whole horizon. A depth frame is held for two or
three control steps; it is encoded once and its tokens are held. Observations arrive normalised.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.layers import GRU, LSTM, MLP, Convolution, dense

_HEAD_SCALE = 0.01  # of the last layer of the action head; assumed: the first actions are near zero


class Carry(NamedTuple):
    """What the actor remembers between two control steps."""

    lstm_c: Float[Array, "E H_lstm"]
    lstm_h: Float[Array, "E H_lstm"]
    gru: Float[Array, "E H_gru"]


class Sight(NamedTuple):
    """What the camera showed during T control steps: K frames, each held for some steps."""

    frames: Float[Array, "K E H W"]  # D, normalised depth
    held: Int[Array, "T E"]  # the frame at hand; one camera clock, so the same for all robots
    seen: Bool[Array, "T E"]  # False until the first frame of an episode has come


class Features(NamedTuple):
    """Encoded frames."""

    tokens: Float[Array, "K E N D"]  # E^d, Eq. 8
    compressed: Float[Array, "K E C"]  # C_psi(D), Eq. 7


class View(NamedTuple):
    """The same with the frames encoded."""

    features: Features
    held: Int[Array, "T E"]
    seen: Bool[Array, "T E"]


class Output(NamedTuple):
    """What the actor says at each step."""

    mean: Float[Array, "T E J"]  # of the action distribution
    log_std: Float[Array, " J"]  # of the action distribution, the same in every state
    velocity: Float[Array, "T E 3"]  # m/s, estimate of the base's linear velocity, body frame
    feature: Float[Array, "T E D"]  # y_t, Eq. 16, that the action is read off
    gate: Float[Array, "T E D"]  # beta_t, Eq. 16: near 1 where the action leans on memory
    attention: Float[Array, "T E heads N"] | None  # weights of the depth tokens, Eq. 10


def initial_carry(c: config.Network, num_envs: int) -> Carry:
    """Return the empty memory of an episode's start."""
    return Carry(
        lstm_c=jnp.zeros((num_envs, c.lstm)),
        lstm_h=jnp.zeros((num_envs, c.lstm)),
        gru=jnp.zeros((num_envs, c.gru)),
    )


def no_features(c: config.Network, image: tuple[int, int], num_envs: int) -> Features:
    """Return features of no frame at all, in the shape of those of one image a robot."""
    shrink = math.prod(stride for _, _, stride in c.convolutions)
    tokens = math.prod(side // shrink for side in image)
    return Features(
        tokens=jnp.zeros((1, num_envs, tokens, c.token)),
        compressed=jnp.zeros((1, num_envs, c.compressed)),
    )


class Actor(nn.Module):
    """The policy: proprioception and depth to the action distribution.

    The velocity loss trains the estimator alone, since the proprioceptive tokenizer sees its output
    through stop_gradient (assumed: the paper only says that they are trained jointly).
    """

    c: config.Network
    num_actions: int

    def setup(self) -> None:
        """Name the parts, of which each variant has its own choice (Sec. III-A)."""
        c = self.c
        if c.variant != "blind":
            self.depth_tokenizer = DepthTokenizer(c)
            self.depth_compression = DepthCompression(c.compressed)
            attends = c.variant != "no_cross_attention"
            self.depth_query = (
                CrossAttention(c.heads, name="cross_attention")
                if attends
                else PooledTokens(name="pooled_tokens")
            )
        self.velocity_estimator = VelocityEstimator(c.lstm)
        # assumed: one hidden layer of the token's width
        self.proprioceptive_tokenizer = MLP((c.token, c.token))
        self.fusion = GatedResidualFusion(gated=c.variant != "no_grf")
        self.recurrent_fusion = RecurrentFusion(c.gru, highway=c.variant != "no_highway")
        self.action_head = MLP((*c.actor, self.num_actions), scale=_HEAD_SCALE)
        std = nn.initializers.constant(math.log(c.initial_std))
        self.log_std = self.param("log_std", std, (self.num_actions,))

    def __call__(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        sight: Sight | None = None,
    ) -> tuple[Carry, Output]:
        """Return the memory after the last step, and the outputs of all steps.

        Args:
            carry: the memory before the first step.
            obs: o^p, normalised (Eq. 2).
            begins: the step is the first of an episode, so the memory is emptied before it.
            sight: the frames, each of which is encoded once; a blind policy has none.
        """
        view = sight and View(self.encode(sight.frames), sight.held, sight.seen)
        return self.decide(carry, obs, begins, view)

    def encode(self, frames: Float[Array, "K E H W"]) -> Features:
        """Return what depends on the frames alone."""
        frames = frames.astype(jnp.float32)
        return Features(self.depth_tokenizer(frames), self.depth_compression(frames))

    def decide(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        view: View | None = None,
    ) -> tuple[Carry, Output]:
        """Do as `__call__` does, with frames that have been encoded.

        Until an episode's first frame has come, what would be read off it is zero.
        """
        if (view is None) != (self.c.variant == "blind"):
            raise ValueError(f"frames are for every variant but 'blind', not for {self.c.variant}")
        inputs, tokens = obs, None
        if view is not None:
            at_hand = jax.tree.map(lambda x: x[view.held[:, 0]], view.features)
            tokens, seen = at_hand.tokens, view.seen[..., None]
            compressed = jnp.where(seen, at_hand.compressed, 0.0)
            inputs = jnp.concatenate([obs, compressed], axis=-1)
        lstm, velocity = self.velocity_estimator((carry.lstm_c, carry.lstm_h), inputs, begins)
        known = jnp.concatenate([obs, jax.lax.stop_gradient(velocity)], axis=-1)
        x = self.proprioceptive_tokenizer(known)
        attention = None
        if tokens is not None:
            found, attention = self.depth_query(x, tokens)
            x = jnp.concatenate([x, jnp.where(seen, found, 0.0)], axis=-1)
        f = self.fusion(x)
        gru, y, gate = self.recurrent_fusion(carry.gru, f, begins)
        output = Output(self.action_head(y), self.log_std, velocity, y, gate, attention)
        return Carry(*lstm, gru), output


class Critic(nn.Module):
    """The value function on privileged observations (Eq. 3)."""

    c: config.Network

    @nn.compact
    def __call__(self, critic_obs: Float[Array, "T E S"]) -> Float[Array, "T E"]:
        """Return V(s_t) for the normalised s_t."""
        return MLP((*self.c.critic, 1), scale=1.0, name="value_head")(critic_obs)[..., 0]


class DepthTokenizer(nn.Module):
    """A depth image to N local tokens, E^d = LN(Z), Z = T_theta(D) (Eq. 6 and 8)."""

    c: config.Network

    @nn.compact
    def __call__(self, frames: Float[Array, "K E H W"]) -> Float[Array, "K E N D"]:
        """Return the tokens, row by row from the top left of the image."""
        x = frames[..., None]
        for i, (channels, kernel, stride) in enumerate(self.c.convolutions):
            x = nn.elu(Convolution(channels, kernel, stride, name=f"layer_{i}")(x))
        x = dense(self.c.token, name="projection")(x.reshape(*x.shape[:2], -1, x.shape[-1]))
        # assumed: attention has no order, so each token learns where it is
        place = self.param("place", nn.initializers.normal(0.02), x.shape[2:])
        return nn.LayerNorm(name="norm")(x + place)


class DepthCompression(nn.Module):
    """A few numbers of a depth image for the velocity estimator, C_psi(D) (Eq. 7).

    assumed: the means of blocks of 8 x 8 pixels, then one layer.
    """

    width: int

    @nn.compact
    def __call__(self, frames: Float[Array, "K E H W"]) -> Float[Array, "K E C"]:
        """Return the compressed frames."""
        k, e, h, w = frames.shape
        blocks = frames.reshape(k, e, h // 8, 8, w // 8, 8).mean(axis=(3, 5))
        return nn.elu(dense(self.width, name="layer_0")(blocks.reshape(k, e, -1)))


class CrossAttention(nn.Module):
    """What the robot's own state asks of the depth tokens (Eq. 8-10).

        Q = LN(e^p) W_q,  K = E^d W_k,  V = E^d W_v,  e^d = MHA(Q, K, V)

    K and V are never formed: q . (E W_k) = (q W_k') . E and w (E W_v) = (w E) W_v, head by head, so
    one query costs a tenth of what the projections of 48 tokens would.
    """

    heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "T E N D"]
    ) -> tuple[Float[Array, "T E D"], Float[Array, "T E heads N"]]:
        """Return the attention's output e^d and its weights."""
        *lead, width = x.shape
        each = width // self.heads
        init = nn.initializers.lecun_normal()
        key = self.param("key", init, (width, width)).reshape(width, self.heads, each)
        value = self.param("value", init, (width, width)).reshape(width, self.heads, each)
        query = dense(width, use_bias=False, name="query")(nn.LayerNorm(name="norm")(x))
        asked = jnp.einsum("tehk,dhk->tehd", query.reshape(*lead, self.heads, each), key)
        scores = jnp.einsum("tehd,tend->tehn", asked, tokens) / math.sqrt(each)
        weights = nn.softmax(scores)
        mixed = jnp.einsum("tehn,tend->tehd", weights, tokens)
        found = jnp.einsum("tehd,dhk->tehk", mixed, value).reshape(*lead, width)
        return dense(width, use_bias=False, name="output")(found), weights


class PooledTokens(nn.Module):
    """The ablation of cross attention: the mean of the tokens, whatever the robot's state is."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "T E N D"]
    ) -> tuple[Float[Array, "T E D"], None]:
        """Return the projected mean, and no weights."""
        return dense(x.shape[-1], name="projection")(tokens.mean(axis=2)), None


class VelocityEstimator(nn.Module):
    """The base's linear velocity, v_hat = W LSTM([o^p; C_psi(D)]) + b (Eq. 7)."""

    hidden: int

    @nn.compact
    def __call__(
        self,
        memory: tuple[Float[Array, "E H"], Float[Array, "E H"]],
        x: Float[Array, "T E I"],
        begins: Bool[Array, "T E"],
    ) -> tuple[tuple[Float[Array, "E H"], Float[Array, "E H"]], Float[Array, "T E 3"]]:
        """Return the cell's (c, h) after the last step, and the velocities in m/s."""
        memory, h = LSTM(self.hidden, name="lstm")(memory, x, begins)
        return memory, dense(3, name="velocity")(h)


class GatedResidualFusion(nn.Module):
    """A residual update whose channels are gated (GRF, Eq. 11-14).

        x~ = ELU(W_1 LN(x) + b_1),  [c; g] = W_2 x~ + b_2,  f = x + c * sigmoid(g)

    All of x, x~, c, g and f have the same width. The ablation has no gate: f = x + c.
    """

    gated: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "T E D"]) -> Float[Array, "T E D"]:
        """Return f."""
        width = x.shape[-1]
        mixed = nn.elu(dense(width, name="mix")(nn.LayerNorm(name="norm")(x)))
        if not self.gated:
            return x + dense(width, name="content")(mixed)
        content, gate = jnp.split(dense(2 * width, name="content_gate")(mixed), 2, axis=-1)
        return x + content * nn.sigmoid(gate)


class RecurrentFusion(nn.Module):
    """A GRU's memory blended with the current feature by a highway gate (Eq. 15-16).

        h_t = GRU(f_t, h_{t-1}),  z_t = W_h h_t
        beta_t = sigmoid(W_beta [z_t; f_t] + b_beta)
        y_t = beta_t * z_t + (1 - beta_t) * f_t

    The ablation has no highway: y_t = z_t, as if beta_t were 1.
    """

    hidden: int
    highway: bool = True

    @nn.compact
    def __call__(
        self, memory: Float[Array, "E H"], f: Float[Array, "T E D"], begins: Bool[Array, "T E"]
    ) -> tuple[Float[Array, "E H"], Float[Array, "T E D"], Float[Array, "T E D"]]:
        """Return the memory after the last step, the fused feature y and the gate beta."""
        width = f.shape[-1]
        memory, h = GRU(self.hidden, name="gru")(memory, f, begins)
        z = dense(width, use_bias=False, name="memory_out")(h)
        if not self.highway:
            return memory, z, jnp.ones_like(z)
        gate = nn.sigmoid(dense(width, name="gate")(jnp.concatenate([z, f], axis=-1)))
        return memory, gate * z + (1.0 - gate) * f, gate
