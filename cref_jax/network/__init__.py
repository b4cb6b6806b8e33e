"""The actor and the critic (Sec. II-B)."""

from cref_jax.network.actor_critic import Actor, Critic
from cref_jax.network.layers import floor_log_std
from cref_jax.network.parkour import DEPTH_MLP, ParkourActor
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
from cref_jax.network.variants import build_actor

__all__ = [
    "DEPTH_MLP",
    "Actor",
    "Carry",
    "Critic",
    "DepthInput",
    "EncodedInput",
    "Features",
    "Output",
    "ParkourActor",
    "build_actor",
    "floor_log_std",
    "image_to_patches",
    "initial_carry",
    "patches_to_image",
    "strides",
    "zero_features",
]
