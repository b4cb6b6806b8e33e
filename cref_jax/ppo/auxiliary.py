"""What the actor's features hold of what only the critic is shown, read out by a linear map.

The paper has no such loss. Where samples are few, features that hold the ground around the robot
are found sooner by it than by the rewards alone. The map itself is no part of the policy.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Readout(NamedTuple):
    """A linear map from D features to the last M of the critic's observations."""

    kernel: Float[Array, "D M"]
    bias: Float[Array, " M"]


def initial_readout(features: int, size: int) -> Readout:
    """Return the map that has learned nothing."""
    return Readout(kernel=jnp.zeros((features, size)), bias=jnp.zeros(size))


def error(
    readout: Readout, feature: Float[Array, "T E D"], critic_obs: Float[Array, "T E S"]
) -> Float[Array, "T E"]:
    """Return the mean square by which it is wrong, in variances of what is read out."""
    wanted = critic_obs[..., -readout.bias.size :]
    return jnp.square(feature @ readout.kernel + readout.bias - wanted).mean(axis=-1)
