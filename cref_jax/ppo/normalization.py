"""Running mean and standard deviation of the observations (Welford 1962, in batches)."""

from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt32

OBSERVATION_CLIP = 10.0  # standard deviations; assumed: larger values carry no information
VARIANCE_FLOOR = 1e-4  # added to each input's variance; assumed: a constant input stays near 0
STD_RANGE = (1e-6, 1e6)  # assumed: outside, float32 divides badly


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@flax.struct.dataclass
class Count:
    """A 64-bit sample count; JAX has no 64-bit integers by default."""

    hi: UInt32[Array, ""]
    lo: UInt32[Array, ""]

    def __add__(self, more: Int[Array, ""] | int) -> "Count":
        """Add samples: a number of a program fits 32 bits, one of Python has any size."""
        high, low = divmod(more, 2**32) if isinstance(more, int) else (0, more)
        lo = self.lo + jnp.uint32(low)
        return Count(self.hi + jnp.uint32(high) + (lo < self.lo).astype(jnp.uint32), lo)

    def __int__(self) -> int:
        """Convert to a Python number."""
        return (int(self.hi) << 32) + int(self.lo)

    def as_float(self) -> Float[Array, ""]:
        """Return the nearest float32."""
        return jnp.float32(self.hi) * jnp.float32(2.0**32) + jnp.float32(self.lo)


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@flax.struct.dataclass
class RunningStatistics:
    """Mean and standard deviation of all valid samples so far."""

    mean: Float[Array, " O"]
    std: Float[Array, " O"]
    count: Count
    summed_variance: Float[Array, " O"]
    std_eps: Float[Array, ""]  # added to the variance


def initial_statistics(size: int) -> RunningStatistics:
    """Create the statistics of no samples: mean 0, deviation 1."""
    zeros = jnp.zeros(size)
    none = jnp.zeros((), jnp.uint32)
    floor = jnp.full((), VARIANCE_FLOOR, jnp.float32)
    return RunningStatistics(zeros, jnp.ones(size), Count(none, none), zeros, floor)


def normalize(statistics: RunningStatistics, x: Float[Array, "*n O"]) -> Float[Array, "*n O"]:
    """Compute (x - mean) / std, clipped to +-OBSERVATION_CLIP."""
    return jnp.clip((x - statistics.mean) / statistics.std, -OBSERVATION_CLIP, OBSERVATION_CLIP)


def update_statistics(
    statistics: RunningStatistics,
    x: Float[Array, "T E O"],
    valid: Bool[Array, "T E"],
    axis: str | None = None,
) -> RunningStatistics:
    """Update the statistics with the valid samples of all devices.

    mean' = mean + sum (x - mean) / n'
    S' = S + sum (x - mean) (x - mean'),  std' = sqrt(S' / n' + std_eps)
    """
    total = lambda v: v if axis is None else jax.lax.psum(v, axis)
    clean, weights = jnp.where(valid[..., None], x, 0.0), valid.astype(x.dtype)
    added = total(jnp.sum(weights).astype(jnp.int32))
    count = statistics.count + added
    samples = jnp.maximum(count.as_float(), 1.0)

    from_old = (clean - statistics.mean) * weights[..., None]
    mean = statistics.mean + total(jnp.sum(from_old, axis=(0, 1)) / samples)
    new_variance = total(jnp.sum(from_old * (clean - mean), axis=(0, 1)))
    summed_variance = statistics.summed_variance + new_variance
    spread = jnp.sqrt(jnp.maximum(summed_variance, 0.0) / samples + statistics.std_eps)
    after = statistics.replace(
        mean=mean,
        std=jnp.clip(spread, *STD_RANGE),
        count=count,
        summed_variance=summed_variance,
    )
    return jax.tree.map(lambda new, old: jnp.where(added > 0, new, old), after, statistics)
