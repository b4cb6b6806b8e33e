"""The actor and the critic (Sec. II-B)."""

from cref_jax.network.actor_critic import Actor, Critic
from cref_jax.network.records import (
    Carry,
    Features,
    Output,
    Sight,
    View,
    as_image,
    in_patches,
    initial_carry,
    no_features,
    strides,
)

__all__ = [
    "Actor",
    "Carry",
    "Critic",
    "Features",
    "Output",
    "Sight",
    "View",
    "as_image",
    "in_patches",
    "initial_carry",
    "no_features",
    "strides",
]
