"""When a foot is down and when it swings: a scuff of one control step is neither.

Contact on a foot's way up or through the air is not yet a touchdown, and a foot that bounces has
not yet lifted off. F = 2 feet (left, right).
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Gait:
    """The phase of each foot."""

    down: Bool[Array, " F"]
    opposed: Int[Array, " F"]  # successive control steps in which contact said otherwise
    air_time: Float[Array, " F"]  # s since the foot last bore on the ground; 0 while it is down
    last_air_time: Float[Array, " F"]  # s, of the last swing; 0 before the first touchdown


class Swings(NamedTuple):
    """Swings that ended in this control step."""

    touchdown: Bool[Array, " F"]
    air_time: Float[Array, " F"]  # s, from the last contact before the swing to the first after it


def standing_gait() -> Gait:
    """Return the gait of a robot that stands: both feet down, no swing yet."""
    still = jnp.zeros(2)
    return Gait(jnp.ones(2, bool), jnp.zeros(2, jnp.int32), still, still)


def update_gait(
    before: Gait, touching: Bool[Array, " F"], period: float, debounce: int
) -> tuple[Gait, Swings]:
    """Update the gait for a control step of `period` s.

    A foot changes its phase when `debounce` steps in a row have said so. The air time leaves the
    steps out in which the touchdown was confirmed.
    """
    opposed = jnp.where(touching != before.down, before.opposed + 1, 0)
    changes = opposed >= debounce
    down = jnp.where(changes, touching, before.down)
    lifted, touchdown = changes & ~touching, changes & touching
    since = jnp.where(lifted, debounce * period, before.air_time + period)
    air_time = since - (debounce - 1) * period
    after = Gait(
        down=down,
        opposed=jnp.where(changes, 0, opposed),
        air_time=jnp.where(down, 0.0, since),
        last_air_time=jnp.where(touchdown, air_time, before.last_air_time),
    )
    return after, Swings(touchdown, jnp.where(touchdown, air_time, 0.0))
