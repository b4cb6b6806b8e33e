"""Auxiliary loss: a linear readout of privileged critic observations from the actor's features.

The paper has no such loss. With few samples it teaches features that encode the ground around the
robot sooner than the rewards alone do. The map itself is not part of the policy.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Readout(NamedTuple):
    """A linear map from D features to the last M of the critic's observations."""

    kernel: Float[Array, "D M"]
    bias: Float[Array, " M"]


def initial_readout(features: int, size: int) -> Readout:
    """Create the untrained map, all zeros."""
    return Readout(kernel=jnp.zeros((features, size)), bias=jnp.zeros(size))


def readout_error(
    readout: Readout, feature: Float[Array, "T E D"], critic_obs: Float[Array, "T E S"]
) -> Float[Array, "T E"]:
    """Compute the mean squared error of the readout, in units of each target's variance."""
    target = critic_obs[..., -readout.bias.size :]
    return jnp.square(feature @ readout.kernel + readout.bias - target).mean(axis=-1)
