"""Means over valid samples and over devices."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree


def mean_valid(
    x: Float[Array, "T E"], valid: Bool[Array, "T E"], axis: str | None = None
) -> Float[Array, ""]:
    """Compute the mean over the valid samples, 0 if there are none.

    With an `axis`, it is scaled so that `mean_over_devices` of it is the mean over the samples of
    all devices.
    """
    count = mean_over_devices(jnp.sum(valid).astype(x.dtype), axis)
    return jnp.sum(jnp.where(valid, x, 0.0)) / jnp.where(count > 0.0, count, 1.0)


def mean_over_devices(x: PyTree, axis: str | None) -> PyTree:
    """Compute the mean over the devices; without an `axis`, return x."""
    return x if axis is None else jax.lax.pmean(x, axis)
