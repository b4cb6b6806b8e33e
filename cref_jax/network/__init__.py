"""The actor and the critic (Sec. II-B)."""

from cref_jax.network.actor_critic import Actor, Critic
from cref_jax.network.records import (
    Carry,
    DepthInput,
    EncodedInput,
    Features,
    Output,
    image_to_patches,
    initial_carry,
    patches_to_image,
    strides,
    zero_features,
)

__all__ = [
    "Actor",
    "Carry",
    "Critic",
    "DepthInput",
    "EncodedInput",
    "Features",
    "Output",
    "image_to_patches",
    "initial_carry",
    "patches_to_image",
    "strides",
    "zero_features",
]
