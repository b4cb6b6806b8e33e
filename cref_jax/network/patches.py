"""Images in patch order, the order in which filters without overlap read them.

A filter whose kernel equals its stride reads each pixel once. In patch order an image is a matrix
whose rows are the inputs of such a filter, so that a layer is a reshape and a product, and so is
its gradient: no gathers or transposes. Patches nest: with strides 4 and 2, a token is 2 x 2
patches, row by row, each of 4 x 4 pixels, row by row.
"""

import math
from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Shaped


def to_patches(
    image: Shaped[Array, "*n H W C"], strides: Sequence[int]
) -> Shaped[Array, "*n rows columns pixels C"]:
    """Reorder images for layers with these strides, first layer first.

    H and W are multiples of the strides' product; rows x columns are the last layer's positions,
    and `pixels` the values of each, in patch order.
    """
    *lead, height, width, channels = image.shape
    side, steps = math.prod(strides), tuple(reversed(strides))
    split = image.reshape(*lead, height // side, *steps, width // side, *steps, channels)
    across = 1 + len(steps)  # axes into which a side of the image is split
    pairs = [axis for k in range(across) for axis in (k, across + k)]
    turned = jnp.transpose(
        split, [*range(len(lead)), *(len(lead) + k for k in pairs), split.ndim - 1]
    )
    return turned.reshape(*lead, height // side, width // side, side * side, channels)


def to_image(
    patches: Shaped[Array, "*n rows columns pixels C"], strides: Sequence[int]
) -> Shaped[Array, "*n H W C"]:
    """Undo `to_patches`."""
    *lead, rows, columns, _, channels = patches.shape
    side = math.prod(strides)
    steps = [stride for stride in reversed(strides) for _ in range(2)]  # down, across
    split = patches.reshape(*lead, rows, columns, *steps, channels)
    pairs = 2 + len(steps)
    order = [*range(0, pairs, 2), *range(1, pairs, 2)]
    turned = jnp.transpose(
        split, [*range(len(lead)), *(len(lead) + k for k in order), split.ndim - 1]
    )
    return turned.reshape(*lead, rows * side, columns * side, channels)
