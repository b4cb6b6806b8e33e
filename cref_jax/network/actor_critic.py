"""The policy and the value function (Sec. II-B, Eq. 6-16).

Everything has the axes [T, E, ...]: a rollout calls the actor with T = 1 and carries the memory on
from step to step, training calls it once with the whole horizon. A depth frame is held for two or
three control steps; it is encoded once and its tokens are held. Observations arrive normalised.
"""

import math

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from cref_jax import config
from cref_jax.network.frame_slots import repeat_frames
from cref_jax.network.layers import MLP
from cref_jax.network.modules import (
    CrossAttention,
    DepthCompression,
    DepthTokenizer,
    GatedResidualFusion,
    PooledTokens,
    RecurrentFusion,
    VelocityEstimator,
)
from cref_jax.network.records import Carry, Features, Output, Sight, View

_HEAD_SCALE = 0.01  # of the last layer of the action head; assumed: the first actions are near zero


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
            compressed = jnp.where(seen, repeat_frames(view.features.compressed, at_hand), 0.0)
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
