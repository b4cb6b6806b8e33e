"""The actor of each variant."""

from cref_jax import config
from cref_jax.network.actor_critic import Actor
from cref_jax.network.parkour import ParkourActor


def build_actor(c: config.Network, num_actions: int) -> Actor | ParkourActor:
    """Build the actor of the variant."""
    kind = ParkourActor if c.variant in config.HPL else Actor
    return kind(c, num_actions)
