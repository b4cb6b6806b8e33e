"""The policy of Humanoid Parkour Learning (Zhuang et al. 2024, arXiv 2406.10759).

A privileged teacher sees the heights of the ground around it, its student a depth image. Widths are
those of the authors' code for quadrupeds; that for humanoids was never released.
"""

import math

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from cref_jax import config
from cref_jax.network import patches, records
from cref_jax.network.frame_slots import repeat_frames
from cref_jax.network.layers import (
    GRU,
    HEAD_SCALE,
    MLP,
    DenseParameters,
    elu,
    floor_log_std,
    product,
)
from cref_jax.network.records import Carry, DepthInput, EncodedInput, Features, Output

_HEIGHT_MLP = (128, 64)  # hidden widths; the latent after them is as wide as C_psi(D), 32
DEPTH_MLP = (128,)  # hidden width after the filters; the latent is as wide as the teacher's


class PooledFilter(nn.Module):
    """A convolution without padding, then the largest of each block of pool x pool, then ELU.

    One product computes the pool x pool positions of a block from the square of pixels that they
    read together: the kernel is laid into that square once per position, with zeros around it. On a
    CPU this is 1.7 times as fast as a product per position, whose pixels are copied more often.
    """

    channels: int
    kernel: int
    pool: int

    @nn.compact
    def __call__(self, x: Float[Array, "K E H W I"]) -> Float[Array, "K E h w O"]:
        """Filter images; rows and columns that fill no block are left out."""
        side, inputs = self.kernel + self.pool - 1, x.shape[-1]
        rows, columns = ((n - self.kernel + 1) // self.pool for n in x.shape[2:4])
        ends = lambda k, count: slice(k, k + self.pool * (count - 1) + 1, self.pool)
        near = [x[:, :, ends(i, rows), ends(j, columns)] for i in range(side) for j in range(side)]
        kernel, bias = DenseParameters(self.channels, name="filter")(self.kernel**2 * inputs)
        kernel = kernel.reshape(self.kernel, self.kernel, inputs, self.channels)
        room = lambda before: (before, side - self.kernel - before)
        at = [(i, j) for i in range(self.pool) for j in range(self.pool)]
        laid = [jnp.pad(kernel, (room(i), room(j), (0, 0), (0, 0))) for i, j in at]
        all_at_once = jnp.stack(laid, axis=3).reshape(side * side * inputs, -1)
        y = product(jnp.concatenate(near, axis=-1), all_at_once)
        return elu(y.reshape(*y.shape[:-1], len(at), self.channels).max(axis=-2) + bias)


class DepthEncoder(nn.Module):
    """The latent of a depth image: filters, each pooled by its stride, then dense layers."""

    c: config.Network

    @nn.compact
    def __call__(self, frames: Float[Array, "K E rows columns pixels"]) -> Float[Array, "K E C"]:
        """Encode the frames."""
        x = patches.to_image(frames[..., None], records.strides(self.c))
        for i, (channels, kernel, pool) in enumerate(self.c.convolutions):
            x = PooledFilter(channels, kernel, pool, name=f"layer_{i}")(x)
        return MLP((*DEPTH_MLP, self.c.compressed), name="latent")(x.reshape(*x.shape[:2], -1))


class ParkourActor(nn.Module):
    """A latent of what is ahead and proprioception into a GRU, its feature into the action head.

    It does not estimate its velocity: the estimate is 0, as are its gradient and an LSTM's memory.
    """

    c: config.Network
    num_actions: int

    def setup(self) -> None:
        """Create the submodules: teacher and student differ in the encoder alone."""
        c = self.c
        if c.variant == "hpl":
            self.depth_encoder = DepthEncoder(c)
        else:
            # the robot walks on when it first sees an edge, and learns from what comes of it
            self.height_encoder = MLP((*_HEIGHT_MLP, c.compressed), scale=HEAD_SCALE)
        self.gru = GRU(c.gru)
        self.action_head = MLP((*c.actor, self.num_actions), scale=HEAD_SCALE)
        std = nn.initializers.constant(math.log(c.initial_std))
        self.log_std = self.param("log_std", std, (self.num_actions,))

    def __call__(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        sight: DepthInput | Float[Array, "T E G"],
    ) -> tuple[Carry, Output]:
        """Compute the memory after the last step, and the outputs of all steps.

        Args:
            carry: the memory before the first step.
            obs: o^p, normalised (Eq. 2).
            begins: the step is the first of an episode; the memory is cleared before it.
            sight: a student's frames, each encoded once; a teacher's heights of the ground above
                the last support, m.
        """
        if isinstance(sight, DepthInput):
            encoded = self.encode(sight.frames)
            return self.decide(
                carry, obs, begins, EncodedInput(encoded, sight.held, sight.seen, sight.hold)
            )
        return self.decide(carry, obs, begins, sight)

    def encode(self, frames: Float[Array, "K E rows columns pixels"]) -> Features:
        """Encode the frames: a latent of each, which is its one token, too."""
        latent = self.depth_encoder(frames.astype(jnp.float32))
        return Features(latent[:, :, None], latent)

    def decide(
        self,
        carry: Carry,
        obs: Float[Array, "T E O"],
        begins: Bool[Array, "T E"],
        view: EncodedInput | Float[Array, "T E G"],
    ) -> tuple[Carry, Output]:
        """Compute the same as `__call__` from encoded frames; before the first the latent is 0."""
        if isinstance(view, EncodedInput):
            latent = repeat_frames(view.features.compressed, view.holding)
            latent = jnp.where(view.seen[..., None], latent, 0.0)
        else:
            latent = self.height_encoder(view)
        gru, h = self.gru(carry.gru, jnp.concatenate([obs, latent], axis=-1), begins)
        log_std = floor_log_std(self.log_std, self.c.min_std)
        velocity = jnp.zeros((*h.shape[:2], 3))
        output = Output(self.action_head(h), log_std, velocity, h, jnp.ones_like(h), None)
        return carry._replace(gru=gru), output
