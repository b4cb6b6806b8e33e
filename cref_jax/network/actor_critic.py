"""The policy and the value function (Sec. II-B, Eq. 6-16).

All arrays have the axes [T, E, ...]: a rollout calls the actor with T = 1 and carries the memory
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
from cref_jax.network.layers import HEAD_SCALE, MLP, floor_log_std
from cref_jax.network.modules import (
    CrossAttention,
    DepthCompression,
    DepthTokenizer,
    GatedResidualFusion,
    PooledTokens,
    RecurrentFusion,
    VelocityEstimator,
)
from cref_jax.network.records import Carry, DepthInput, EncodedInput, Features, Output


class Actor(nn.Module):
    """The policy, from proprioception and depth to the action distribution.

    The velocity loss trains the estimator alone, since the proprioceptive tokenizer gets its output
    through stop_gradient (assumed: the paper only states that they are trained jointly).
    """

    c: config.Network
    num_actions: int

    def setup(self) -> None:
        """Create the submodules of the variant (Sec. III-A)."""
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
        self.action_head = MLP((*c.actor, self.num_actions), scale=HEAD_SCALE)
        std = nn.initializers.constant(math.log(c.initial_std))
        self.log_std = self.param("log_std", std, (self.num_actions,))

    def __call__(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        sight: DepthInput | None = None,
    ) -> tuple[Carry, Output]:
        """Compute the memory after the last step, and the outputs of all steps.

        Args:
            carry: the memory before the first step.
            obs: o^p, normalised (Eq. 2).
            begins: the step is the first of an episode; the memory is cleared before it.
            sight: the frames, each encoded once; None for a blind policy.
        """
        view = sight and EncodedInput(self.encode(sight.frames), sight.held, sight.seen, sight.hold)
        return self.decide(carry, obs, begins, view)

    def encode(self, frames: Float[Array, "K E rows columns pixels"]) -> Features:
        """Encode the frames: tokens and compressed features."""
        frames = frames.astype(jnp.float32)
        return Features(self.depth_tokenizer(frames), self.depth_compression(frames))

    def decide(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        view: EncodedInput | None = None,
    ) -> tuple[Carry, Output]:
        """Compute the same as `__call__` from encoded frames.

        Until an episode's first frame has arrived, its features and attention are zero.

        Raises:
            ValueError: frames for a blind policy, or none for another.
        """
        if (view is None) != (self.c.variant == "blind"):
            raise ValueError(f"all variants but 'blind' take frames; this is '{self.c.variant}'")
        inputs = obs
        if view is not None:
            at_hand, valid = view.holding, view.seen[..., None]
            compressed = jnp.where(valid, repeat_frames(view.features.compressed, at_hand), 0.0)
            inputs = jnp.concatenate([obs, compressed], axis=-1)
        lstm, velocity = self.velocity_estimator((carry.lstm_c, carry.lstm_h), inputs, begins)
        known = jnp.concatenate([obs, jax.lax.stop_gradient(velocity)], axis=-1)
        x = self.proprioceptive_tokenizer(known)
        attention = None
        if view is not None:
            context, attention = self.depth_query(x, view.features.tokens, at_hand)
            x = jnp.concatenate([x, jnp.where(valid, context, 0.0)], axis=-1)
        f = self.fusion(x)
        gru, y, gate = self.recurrent_fusion(carry.gru, f, begins)
        log_std = floor_log_std(self.log_std, self.c.min_std)
        output = Output(self.action_head(y), log_std, velocity, y, gate, attention)
        return Carry(*lstm, gru), output


class Critic(nn.Module):
    """The value function on privileged observations (Eq. 3)."""

    c: config.Network

    @nn.compact
    def __call__(self, critic_obs: Float[Array, "T E S"]) -> Float[Array, "T E"]:
        """Compute V(s_t) for the normalised s_t."""
        return MLP((*self.c.critic, 1), scale=1.0, name="value_head")(critic_obs)[..., 0]
