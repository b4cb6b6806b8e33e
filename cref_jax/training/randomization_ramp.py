"""Randomisation that grows with competence: one share of its ranges, for all who meet it.

A policy that falls at once under the full ranges learns nothing from them, and one that hardly
falls has nothing left to learn from smaller ones.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cref_jax import config
from cref_jax.terrain.atlas import Atlas

_MEMORY = 0.9  # weight of earlier falls in the running mean, per iteration; assumed


@no_type_check  # vmap and tree.map fill it with batches and with non-arrays
@flax.struct.dataclass
class Ramp:
    """The share of the randomisation ranges in use, and the fall rate that controls it."""

    share: Float[Array, ""]  # of the ranges in the configuration, 0 to 1
    falls: Float[Array, ""]  # per minute and robot, running mean over iterations


def initial_ramp(c: config.Randomisation) -> Ramp:
    """Create the initial ramp: no randomisation, or all of it if the ramp is disabled."""
    low, high = c.ramp_falls
    return Ramp(jnp.float32(0.0 if c.ramp else 1.0), jnp.float32(0.5 * (low + high)))


class Parts(NamedTuple):
    """Which robots of a device meet what; all others meet everything."""

    undisturbed: Bool[np.ndarray, " E"]
    pushed_alone: Bool[np.ndarray, " E"]


def deal_parts(c: config.Randomisation, lanes: Atlas, num_envs: int) -> Parts:
    """Deal out who meets what, the same shares on each lane.

    Multiples of the golden ratio, modulo 1, fill [0, 1) evenly, however few turns there are.
    """
    turn = np.arange(num_envs) // len(lanes.turns)
    place = np.modf(turn * 0.5 * (np.sqrt(5.0) - 1.0))[0]
    undisturbed = place < c.undisturbed
    return Parts(undisturbed, ~undisturbed & (place < c.undisturbed + c.pushed_alone))


def update_ramp(ramp: Ramp, falls: Float[Array, ""], c: config.Randomisation) -> Ramp:
    """Raise the share if falls per minute are few, lower it if many, else keep it."""
    if not c.ramp:
        return ramp
    mean = _MEMORY * ramp.falls + (1.0 - _MEMORY) * falls
    low, high = c.ramp_falls
    up, down = (mean < low).astype(jnp.float32), (mean > high).astype(jnp.float32)
    return Ramp(jnp.clip(ramp.share + c.ramp_step * (up - down), 0.0, 1.0), mean)
