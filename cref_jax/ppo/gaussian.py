"""Diagonal Gaussian action distribution; the last axis is the joint."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def log_prob(
    x: Float[Array, "*n J"], mean: Float[Array, "*n J"], log_std: Float[Array, "*#n J"]
) -> Float[Array, "*n"]:
    """Compute log N(x; mean, std^2), summed over the independent coordinates."""
    z = (x - mean) * jnp.exp(-log_std)
    return -jnp.sum(0.5 * jnp.square(z) + log_std + 0.5 * math.log(2.0 * math.pi), axis=-1)


def entropy(log_std: Float[Array, " J"]) -> Float[Array, ""]:
    """Compute the entropy of a Gaussian, sum of log std + log(2 pi e) / 2, in nats."""
    return jnp.sum(log_std + 0.5 * math.log(2.0 * math.pi * math.e))


def kl(
    mean: Float[Array, "*n J"],
    log_std: Float[Array, "*n J"],
    new_mean: Float[Array, "*n J"],
    new_log_std: Float[Array, " J"],
) -> Float[Array, "*n"]:
    """Compute KL(old || new) of two Gaussians, in nats.

    sum of log(s'/s) + (s^2 + (m - m')^2) / (2 s'^2) - 1/2
    """
    growth = new_log_std - log_std
    shift = (mean - new_mean) * jnp.exp(-new_log_std)
    return jnp.sum(growth + 0.5 * (jnp.exp(-2.0 * growth) + jnp.square(shift) - 1.0), axis=-1)


def kl_of_means(
    mean: Float[Array, "*n J"], new_mean: Float[Array, "*n J"], log_std: Float[Array, " J"]
) -> Float[Array, "*n"]:
    """Compute the same of two Gaussians of equal deviations: sum of (m - m')^2 / (2 s^2)."""
    return 0.5 * jnp.sum(jnp.square((mean - new_mean) * jnp.exp(-log_std)), axis=-1)
