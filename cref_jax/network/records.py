"""Inputs and outputs of the network, and the pixel order of frames."""

import math
from typing import NamedTuple, no_type_check

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.network import patches
from cref_jax.network.frame_slots import Holding, assign_slots


class Carry(NamedTuple):
    """The actor's memory between control steps."""

    lstm_c: Float[Array, "E H_lstm"]
    lstm_h: Float[Array, "E H_lstm"]
    gru: Float[Array, "E H_gru"]


@no_type_check  # tree.map puts non-arrays in it
@flax.struct.dataclass
class DepthInput:
    """Depth frames during T control steps: K frames, each held for several steps."""

    frames: Float[Array, "K E rows columns pixels"]  # D, normalised depth, see `image_to_patches`
    held: Int[Array, "T E"]  # index of the current frame; one camera clock, so equal for all robots
    seen: Bool[Array, "T E"]  # False until an episode's first frame has arrived
    hold: int | None = flax.struct.field(pytree_node=False, default=None)
    """Maximum number of steps that hold a frame; None: no limit."""


class Features(NamedTuple):
    """Encoded frames."""

    tokens: Float[Array, "K E N D"]  # E^d, Eq. 8
    compressed: Float[Array, "K E C"]  # C_psi(D), Eq. 7


@no_type_check
@flax.struct.dataclass
class EncodedInput:
    """The `DepthInput` with encoded frames."""

    features: Features
    held: Int[Array, "T E"]
    seen: Bool[Array, "T E"]
    hold: int | None = flax.struct.field(pytree_node=False, default=None)

    @property
    def holding(self) -> Holding:
        """The slot of each step in its frame."""
        steps, frames = self.held.shape[0], self.features.tokens.shape[0]
        return assign_slots(self.held[:, 0], frames, min(self.hold or steps, steps))


class Output(NamedTuple):
    """The actor's output at each step."""

    mean: Float[Array, "T E J"]  # of the action distribution
    log_std: Float[Array, " J"]  # of the action distribution, the same in every state
    velocity: Float[Array, "T E 3"]  # m/s, estimate of the base's linear velocity, body frame
    feature: Float[Array, "T E D"]  # y_t, Eq. 16, the input of the action head
    gate: Float[Array, "T E D"]  # beta_t, Eq. 16: near 1 where the action relies on memory
    attention: Float[Array, "T E heads N"] | None  # weights of the depth tokens, Eq. 10


def initial_carry(c: config.Network, num_envs: int) -> Carry:
    """Create the empty memory at an episode's start."""
    return Carry(
        lstm_c=jnp.zeros((num_envs, c.lstm)),
        lstm_h=jnp.zeros((num_envs, c.lstm)),
        gru=jnp.zeros((num_envs, c.gru)),
    )


def zero_features(c: config.Network, image: tuple[int, int], num_envs: int) -> Features:
    """Create zero features with the shape of one encoded image per robot."""
    shrink = math.prod(stride for _, _, stride in c.convolutions)
    tokens = math.prod(side // shrink for side in image), c.token
    if c.variant == "hpl":
        tokens = 1, c.compressed
    return Features(
        tokens=jnp.zeros((1, num_envs, *tokens)),
        compressed=jnp.zeros((1, num_envs, c.compressed)),
    )


def image_to_patches(
    c: config.Network, image: Float[Array, "*n H W"]
) -> Float[Array, "*n r c pixels"]:
    """Reorder depth images into the patch order of the depth tokenizer."""
    return patches.to_patches(image[..., None], strides(c))[..., 0]


def patches_to_image(
    c: config.Network, frame: Float[Array, "*n r c pixels"]
) -> Float[Array, "*n H W"]:
    """Undo `image_to_patches`."""
    return patches.to_image(frame[..., None], strides(c))[..., 0]


def strides(c: config.Network) -> tuple[int, ...]:
    """Return the strides of the depth encoder's layers, in pixels of the previous layer."""
    return tuple(stride for _, _, stride in c.convolutions)
