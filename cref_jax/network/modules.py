"""The network's modules, each an equation of Sec. II-B."""

import math

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from cref_jax import config
from cref_jax.network import patches, records
from cref_jax.network.frame_slots import Holding, gather_by_frame, gather_by_step, repeat_frames
from cref_jax.network.layers import (
    GRU,
    LSTM,
    Convolution,
    LayerNorm,
    PatchFilter,
    dense,
    elu,
    product,
)

_BLOCK = 8  # pixels, side of the depth compression's blocks


class DepthTokenizer(nn.Module):
    """The tokenizer of a depth image, N local tokens E^d = LN(Z), Z = T_theta(D) (Eq. 6 and 8)."""

    c: config.Network

    @nn.compact
    def __call__(self, frames: Float[Array, "K E rows columns pixels"]) -> Float[Array, "K E N D"]:
        """Compute the tokens, row by row from the top left of the image."""
        x, strides = frames[..., None], records.strides(self.c)
        for i, (channels, kernel, stride) in enumerate(self.c.convolutions):
            after = strides[i + 1 :]
            if kernel == stride:
                group = after[0] ** 2 if after else 1
                layer = PatchFilter(channels, group, name=f"layer_{i}")
                y = layer(x.reshape(-1, stride * stride * x.shape[-1]))
                x = elu(y).reshape(*x.shape[:4], -1, channels)
            else:
                image = patches.to_image(x, strides[i:])
                image = elu(Convolution(channels, kernel, stride, name=f"layer_{i}")(image))
                x = patches.to_patches(image, after)
        x = dense(self.c.token, name="projection")(x.reshape(*x.shape[:2], -1, x.shape[-1]))
        # assumed: attention ignores order, so each token learns its place
        place = self.param("place", nn.initializers.normal(0.02), x.shape[2:])
        return LayerNorm(name="norm")(x + place)


class DepthCompression(nn.Module):
    """The compression of a depth image for the velocity estimator, C_psi(D) (Eq. 7).

    assumed: means over blocks of 8 x 8 pixels, then one layer.
    """

    c: config.Network

    @nn.compact
    def __call__(self, frames: Float[Array, "K E rows columns pixels"]) -> Float[Array, "K E C"]:
        """Compress the frames."""
        strides = records.strides(self.c)
        if math.prod(strides) != _BLOCK:
            image = patches.to_image(frames[..., None], strides)
            frames = patches.to_patches(image, (_BLOCK,))[..., 0]
        means = frames.mean(axis=-1).reshape(*frames.shape[:2], -1)
        return elu(dense(self.c.compressed, name="layer_0")(means))


class CrossAttention(nn.Module):
    """Cross attention from the robot's own state to the depth tokens (Eq. 8-10).

        Q = LN(e^p) W_q,  K = E^d W_k,  V = E^d W_v,  e^d = MHA(Q, K, V)

    K and V are never formed: q . (E W_k) = (q W_k') . E and w (E W_v) = (w E) W_v, head by head, so
    one query costs a tenth of projecting 48 tokens. All steps that hold a frame query it at once.
    """

    heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "K E N D"], at_hand: Holding
    ) -> tuple[Float[Array, "T E D"], Float[Array, "T E heads N"]]:
        """Compute the attention's output e^d and its weights."""
        width, (frames, robots, count, _) = x.shape[-1], tokens.shape
        init = nn.initializers.lecun_normal()
        key = _block_diagonal(self.param("key", init, (width, width)), self.heads).T
        value = _block_diagonal(self.param("value", init, (width, width)), self.heads)
        query = dense(width, use_bias=False, name="query")(LayerNorm(name="norm")(x))
        queries = product(gather_by_frame(query, at_hand), key).reshape(frames, robots, -1, width)
        scores = jnp.einsum("kesd,kend->kesn", queries, tokens) / math.sqrt(width // self.heads)
        weights = nn.softmax(scores)
        mixed = jnp.einsum("kesn,kend->kesd", weights, tokens)
        mixed = mixed.reshape(frames, robots, -1, self.heads * width)
        output = gather_by_step(product(mixed, value), at_hand)
        weights = gather_by_step(weights.reshape(frames, robots, -1, self.heads * count), at_hand)
        per_step = weights.reshape(*x.shape[:2], self.heads, count)
        return dense(width, use_bias=False, name="output")(output), per_step


def _block_diagonal(kernel: Float[Array, "D hd"], heads: int) -> Float[Array, "hD hd"]:
    """Build the block-diagonal matrix from each head's D inputs to its own outputs alone."""
    width = kernel.shape[0]
    of_head = kernel.reshape(width, heads, -1)
    blocks = jnp.eye(heads)[:, None, :, None] * of_head[None]
    return blocks.reshape(heads * width, -1)


class PooledTokens(nn.Module):
    """The ablation of cross attention: the mean of the tokens, independent of the state."""

    @nn.compact
    def __call__(
        self, x: Float[Array, "T E D"], tokens: Float[Array, "K E N D"], at_hand: Holding
    ) -> tuple[Float[Array, "T E D"], None]:
        """Compute the projected mean; None in place of weights."""
        pooled = dense(x.shape[-1], name="projection")(tokens.mean(axis=2))
        return repeat_frames(pooled, at_hand), None


class VelocityEstimator(nn.Module):
    """The estimator of the base's linear velocity, v_hat = W LSTM([o^p; C_psi(D)]) + b (Eq. 7)."""

    hidden: int

    @nn.compact
    def __call__(
        self,
        memory: tuple[Float[Array, "E H"], Float[Array, "E H"]],
        x: Float[Array, "T E I"],
        begins: Bool[Array, "T E"],
    ) -> tuple[tuple[Float[Array, "E H"], Float[Array, "E H"]], Float[Array, "T E 3"]]:
        """Compute the cell's (c, h) after the last step, and the velocities, m/s."""
        memory, h = LSTM(self.hidden, name="lstm")(memory, x, begins)
        return memory, dense(3, name="velocity")(h)


class GatedResidualFusion(nn.Module):
    """A residual update with gated channels (GRF, Eq. 11-14).

        x~ = ELU(W_1 LN(x) + b_1),  [c; g] = W_2 x~ + b_2,  f = x + c * sigmoid(g)

    All of x, x~, c, g and f have the same width. The ablation has no gate: f = x + c.
    """

    gated: bool = True

    @nn.compact
    def __call__(self, x: Float[Array, "T E D"]) -> Float[Array, "T E D"]:
        """Compute f."""
        width = x.shape[-1]
        mixed = elu(dense(width, name="mix")(LayerNorm(name="norm")(x)))
        if not self.gated:
            return x + dense(width, name="content")(mixed)
        content, gate = jnp.split(dense(2 * width, name="content_gate")(mixed), 2, axis=-1)
        return x + content * nn.sigmoid(gate)


class RecurrentFusion(nn.Module):
    """A GRU's memory blended with the current feature by a highway gate (Eq. 15-16).

        h_t = GRU(f_t, h_{t-1}),  z_t = W_h h_t
        beta_t = sigmoid(W_beta [z_t; f_t] + b_beta)
        y_t = beta_t * z_t + (1 - beta_t) * f_t

    The ablation has no highway: y_t = z_t, as if beta_t were 1.
    """

    hidden: int
    highway: bool = True

    @nn.compact
    def __call__(
        self, memory: Float[Array, "E H"], f: Float[Array, "T E D"], begins: Bool[Array, "T E"]
    ) -> tuple[Float[Array, "E H"], Float[Array, "T E D"], Float[Array, "T E D"]]:
        """Compute the memory after the last step, the fused feature y and the gate beta."""
        width = f.shape[-1]
        memory, h = GRU(self.hidden, name="gru")(memory, f, begins)
        z = dense(width, use_bias=False, name="memory_out")(h)
        if not self.highway:
            return memory, z, jnp.ones_like(z)
        gate = nn.sigmoid(dense(width, name="gate")(jnp.concatenate([z, f], axis=-1)))
        return memory, gate * z + (1.0 - gate) * f, gate
