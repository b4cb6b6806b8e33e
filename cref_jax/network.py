"""The policy and the value function (Sec. II-B, Eq. 6-16).

Everything has the axes [T, E, ...]: a rollout calls the actor with T = 1 and carries the memory on
from step to step, training calls it once with the whole horizon. A depth frame is held for two or
three control steps; it is encoded once and its tokens are held. Observations arrive normalised.
"""

import math
from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config, patches
from cref_jax.holding import Holding, by_frame, by_step, holding, repeated
from cref_jax.layers import GRU, LSTM, MLP, Convolution, LayerNorm, PatchFilter, dense, elu, product

_BLOCK = 8  # pixels, side of the blocks of the depth compression
_HEAD_SCALE = 0.01  # of the last layer of the action head; assumed: the first actions are near zero


class Carry(NamedTuple):
    """What the actor remembers between two control steps."""

    lstm_c: Float[Array, "E H_lstm"]
    lstm_h: Float[Array, "E H_lstm"]
    gru: Float[Array, "E H_gru"]


@no_type_check  # tree.map fills it with what is no array
@flax.struct.dataclass
class Sight:
    """What the camera showed during T control steps: K frames, each held for some steps."""

    frames: Float[Array, "K E rows columns pixels"]  # D, normalised depth, see `in_patches`
    held: Int[Array, "T E"]  # the frame at hand; one camera clock, so the same for all robots
    seen: Bool[Array, "T E"]  # False until the first frame of an episode has come
    hold: int | None = flax.struct.field(pytree_node=False, default=None)
    # steps that a frame is held for at most; when left out any number


class Features(NamedTuple):
    """Encoded frames."""

    tokens: Float[Array, "K E N D"]  # E^d, Eq. 8
    compressed: Float[Array, "K E C"]  # C_psi(D), Eq. 7


@no_type_check
@flax.struct.dataclass
class View:
    """The same with the frames encoded."""

    features: Features
    held: Int[Array, "T E"]
    seen: Bool[Array, "T E"]
    hold: int | None = flax.struct.field(pytree_node=False, default=None)

    @property
    def holding(self) -> Holding:
        """Where each step is among those that hold its frame."""
        steps, frames = self.held.shape[0], self.features.tokens.shape[0]
        return holding(self.held[:, 0], frames, min(self.hold or steps, steps))


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


def in_patches(c: config.Network, image: Float[Array, "*n H W"]) -> Float[Array, "*n r c pixels"]:
    """Return depth images in the order in which the depth tokenizer reads them."""
    return patches.to_patches(image[..., None], _strides(c))[..., 0]


def as_image(c: config.Network, frame: Float[Array, "*n r c pixels"]) -> Float[Array, "*n H W"]:
    """Return what `in_patches` was given."""
    return patches.to_image(frame[..., None], _strides(c))[..., 0]


def _strides(c: config.Network) -> tuple[int, ...]:
    return tuple(stride for _, _, stride in c.convolutions)


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
            self.depth_compression = DepthCompression(c)
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
        view = sight and View(self.encode(sight.frames), sight.held, sight.seen, sight.hold)
        return self.decide(carry, obs, begins, view)

    def encode(self, frames: Float[Array, "K E rows columns pixels"]) -> Features:
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
        inputs = obs
        if view is not None:
            at_hand, seen = view.holding, view.seen[..., None]
            compressed = jnp.where(seen, repeated(view.features.compressed, at_hand), 0.0)
            inputs = jnp.concatenate([obs, compressed], axis=-1)
        lstm, velocity = self.velocity_estimator((carry.lstm_c, carry.lstm_h), inputs, begins)
        known = jnp.concatenate([obs, jax.lax.stop_gradient(velocity)], axis=-1)
        x = self.proprioceptive_tokenizer(known)
        attention = None
        if view is not None:
            found, attention = self.depth_query(x, view.features.tokens, at_hand)
            x = jnp.concatenate([x, jnp.where(seen, found, 0.0)], axis=-1)
        f = self.fusion(x)
        gru, y, gate = self.recurrent_fusion(carry.gru, f, begins)
        log_std = jnp.maximum(self.log_std, math.log(max(self.c.min_std, 1e-9)))
        output = Output(self.action_head(y), log_std, velocity, y, gate, attention)
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
    def __call__(self, frames: Float[Array, "K E rows columns pixels"]) -> Float[Array, "K E N D"]:
        """Return the tokens, row by row from the top left of the image."""
        x, strides = frames[..., None], _strides(self.c)
        for i, (channels, kernel, stride) in enumerate(self.c.convolutions):
            after = strides[i + 1 :]
            if kernel == stride:
                group = after[0] ** 2 if after else 1
                layer = PatchFilter(channels, group, name=f"layer_{i}")
                y = layer(x.reshape(-1, stride * stride * x.shape[-1]))
                x = elu(y).reshape(*x.shape[:4], -1, channels)
            else:
                image = patches.to_image(x, strides[i:])
                image = elu(Convolution(channels, kernel, stride, name=f"layer_{i}")(image))
                x = patches.to_patches(image, after)
        x = dense(self.c.token, name="projection")(x.reshape(*x.shape[:2], -1, x.shape[-1]))
        # assumed: attention has no order, so each token learns where it is
        place = self.param("place", nn.initializers.normal(0.02), x.shape[2:])
        return LayerNorm(name="norm")(x + place)


class DepthCompression(nn.Module):
    """A few numbers of a depth image for the velocity estimator, C_psi(D) (Eq. 7).

    assumed: the means of blocks of 8 x 8 pixels, then one layer.
    """

    c: config.Network

    @nn.compact
    def __call__(self, frames: Float[Array, "K E rows columns pixels"]) -> Float[Array, "K E C"]:
        """Return the compressed frames."""
        strides = _strides(self.c)
        if math.prod(strides) != _BLOCK:
            image = patches.to_image(frames[..., None], strides)
            frames = patches.to_patches(image, (_BLOCK,))[..., 0]
        means = frames.mean(axis=-1).reshape(*frames.shape[:2], -1)
        return elu(dense(self.c.compressed, name="layer_0")(means))


class CrossAttention(nn.Module):
    """What the robot's own state asks of the depth tokens (Eq. 8-10).

        Q = LN(e^p) W_q,  K = E^d W_k,  V = E^d W_v,  e^d = MHA(Q, K, V)

    K and V are never formed: q . (E W_k) = (q W_k') . E and w (E W_v) = (w E) W_v, head by head, so
    one query costs a tenth of what the projections of 48 tokens would. All steps that hold a frame
    ask it at once.
    """

    heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "K E N D"], at_hand: Holding
    ) -> tuple[Float[Array, "T E D"], Float[Array, "T E heads N"]]:
        """Return the attention's output e^d and its weights."""
        width, (frames, robots, count, _) = x.shape[-1], tokens.shape
        init = nn.initializers.lecun_normal()
        key = _each_head(self.param("key", init, (width, width)), self.heads).T
        value = _each_head(self.param("value", init, (width, width)), self.heads)
        query = dense(width, use_bias=False, name="query")(LayerNorm(name="norm")(x))
        asked = product(by_frame(query, at_hand), key).reshape(frames, robots, -1, width)
        scores = jnp.einsum("kesd,kend->kesn", asked, tokens) / math.sqrt(width // self.heads)
        weights = nn.softmax(scores)
        mixed = jnp.einsum("kesn,kend->kesd", weights, tokens)
        mixed = mixed.reshape(frames, robots, -1, self.heads * width)
        found = by_step(product(mixed, value), at_hand)
        weights = by_step(weights.reshape(frames, robots, -1, self.heads * count), at_hand)
        shown = weights.reshape(*x.shape[:2], self.heads, count)
        return dense(width, use_bias=False, name="output")(found), shown


def _each_head(kernel: Float[Array, "D hd"], heads: int) -> Float[Array, "hD hd"]:
    """Return the matrix that takes each head's D inputs to its own outputs, and no other's."""
    width = kernel.shape[0]
    of_head = kernel.reshape(width, heads, -1)
    apart = jnp.eye(heads)[:, None, :, None] * of_head[None]
    return apart.reshape(heads * width, -1)


class PooledTokens(nn.Module):
    """The ablation of cross attention: the mean of the tokens, whatever the robot's state is."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "K E N D"], at_hand: Holding
    ) -> tuple[Float[Array, "T E D"], None]:
        """Return the projected mean, and no weights."""
        pooled = dense(x.shape[-1], name="projection")(tokens.mean(axis=2))
        return repeated(pooled, at_hand), None


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
        mixed = elu(dense(width, name="mix")(LayerNorm(name="norm")(x)))
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
