"""The policy of Humanoid Parkour Learning (Zhuang et al. 2024, arXiv 2406.10759).

A privileged teacher sees the heights of the ground around it. Widths are those of the authors'
code for quadrupeds; that for humanoids was never released.
"""

import math

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from cref_jax import config
from cref_jax.network.layers import GRU, HEAD_SCALE, MLP
from cref_jax.network.records import Carry, Output

_HEIGHT_MLP = (128, 64)  # hidden widths; the latent after them is as wide as C_psi(D), 32
_HEIGHT_SCALE = 5.0  # 1/m; legged_gym's, so that steps of 20 cm are near 1


class ParkourActor(nn.Module):
    """A latent of what is ahead and proprioception into a GRU, its feature into the action head.

    It does not estimate its velocity: the estimate is 0, and so is its gradient.
    """

    c: config.Network
    num_actions: int

    def setup(self) -> None:
        """Create the submodules."""
        c = self.c
        self.height_encoder = MLP((*_HEIGHT_MLP, c.compressed))
        self.gru = GRU(c.gru)
        self.action_head = MLP((*c.actor, self.num_actions), scale=HEAD_SCALE)
        std = nn.initializers.constant(math.log(c.initial_std))
        self.log_std = self.param("log_std", std, (self.num_actions,))

    def __call__(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        sight: Float[Array, "T E G"],
    ) -> tuple[Carry, Output]:
        """Compute the memory after the last step, and the outputs of all steps.

        Args:
            carry: the memory before the first step.
            obs: o^p, normalised (Eq. 2).
            begins: the step is the first of an episode; the memory is cleared before it.
            sight: heights of the base above the ground, m.
        """
        return self.decide(carry, obs, begins, sight)

    def decide(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        view: Float[Array, "T E G"],
    ) -> tuple[Carry, Output]:
        """Compute the same as `__call__`."""
        latent = self.height_encoder(_HEIGHT_SCALE * view)
        gru, h = self.gru(carry.gru, jnp.concatenate([obs, latent], axis=-1), begins)
        log_std = jnp.maximum(self.log_std, math.log(max(self.c.min_std, 1e-9)))
        velocity = jnp.zeros((*h.shape[:2], 3))
        output = Output(self.action_head(h), log_std, velocity, h, jnp.ones_like(h), None)
        return carry._replace(gru=gru), output
