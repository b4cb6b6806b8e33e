"""What goes into the network and comes out of it, and the order of a frame's pixels."""

import math
from typing import NamedTuple, no_type_check

import flax.struct
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.network import patches
from cref_jax.network.frame_slots import Holding, holding


class Carry(NamedTuple):
    """What the actor remembers between two control steps."""

    lstm_c: Float[Array, "E H_lstm"]
    lstm_h: Float[Array, "E H_lstm"]
    gru: Float[Array, "E H_gru"]


@no_type_check  # tree.map fills it with what is no array
@flax.struct.dataclass
class Sight:
    """What the camera showed during T control steps: K frames, each held for some steps."""

    frames: Float[Array, "K E rows columns pixels"]  # D, normalised depth, see `in_patches`
    held: Int[Array, "T E"]  # the frame at hand; one camera clock, so the same for all robots
    seen: Bool[Array, "T E"]  # False until the first frame of an episode has come
    hold: int | None = flax.struct.field(pytree_node=False, default=None)
    # steps that a frame is held for at most; when left out any number


class Features(NamedTuple):
    """Encoded frames."""

    tokens: Float[Array, "K E N D"]  # E^d, Eq. 8
    compressed: Float[Array, "K E C"]  # C_psi(D), Eq. 7


@no_type_check
@flax.struct.dataclass
class View:
    """The same with the frames encoded."""

    features: Features
    held: Int[Array, "T E"]
    seen: Bool[Array, "T E"]
    hold: int | None = flax.struct.field(pytree_node=False, default=None)

    @property
    def holding(self) -> Holding:
        """Where each step is among those that hold its frame."""
        steps, frames = self.held.shape[0], self.features.tokens.shape[0]
        return holding(self.held[:, 0], frames, min(self.hold or steps, steps))


class Output(NamedTuple):
    """What the actor says at each step."""

    mean: Float[Array, "T E J"]  # of the action distribution
    log_std: Float[Array, " J"]  # of the action distribution, the same in every state
    velocity: Float[Array, "T E 3"]  # m/s, estimate of the base's linear velocity, body frame
    feature: Float[Array, "T E D"]  # y_t, Eq. 16, that the action is read off
    gate: Float[Array, "T E D"]  # beta_t, Eq. 16: near 1 where the action leans on memory
    attention: Float[Array, "T E heads N"] | None  # weights of the depth tokens, Eq. 10


def initial_carry(c: config.Network, num_envs: int) -> Carry:
    """Return the empty memory of an episode's start."""
    return Carry(
        lstm_c=jnp.zeros((num_envs, c.lstm)),
        lstm_h=jnp.zeros((num_envs, c.lstm)),
        gru=jnp.zeros((num_envs, c.gru)),
    )


def no_features(c: config.Network, image: tuple[int, int], num_envs: int) -> Features:
    """Return features of no frame at all, in the shape of those of one image a robot."""
    shrink = math.prod(stride for _, _, stride in c.convolutions)
    tokens = math.prod(side // shrink for side in image)
    return Features(
        tokens=jnp.zeros((1, num_envs, tokens, c.token)),
        compressed=jnp.zeros((1, num_envs, c.compressed)),
    )


def in_patches(c: config.Network, image: Float[Array, "*n H W"]) -> Float[Array, "*n r c pixels"]:
    """Return depth images in the order in which the depth tokenizer reads them."""
    return patches.to_patches(image[..., None], strides(c))[..., 0]


def as_image(c: config.Network, frame: Float[Array, "*n r c pixels"]) -> Float[Array, "*n H W"]:
    """Return what `in_patches` was given."""
    return patches.to_image(frame[..., None], strides(c))[..., 0]


def strides(c: config.Network) -> tuple[int, ...]:
    """Return the strides of the depth encoder's layers, pixels of the layer before."""
    return tuple(stride for _, _, stride in c.convolutions)
