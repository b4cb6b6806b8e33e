"""A frame is held for some control steps: what is told by step, told by frame, and back.

What is asked of a frame's tokens in the steps that hold it is asked at once, so the tokens are
never repeated for each step. A frame has as many slots as it can be held for; a step takes the next
one of the frame at hand, and slots that are left over are in no result. Each direction is the
other's gradient, so that nothing is added up by index: on a GPU such sums come in any order.
"""

from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Holding:
    """Which of K frames is at hand at each of T steps, and in which of its S slots."""

    frame: Int[Array, " T"]
    slot: Int[Array, " T"]
    step: Int[Array, "K S"]  # that takes the slot
    taken: Bool[Array, "K S"]


def holding(frame: Int[Array, " T"], frames: int, slots: int) -> Holding:
    """Return where each step is among the slots.

    Args:
        frame: the frame at hand at each step; no frame comes back after another one.
        frames: how many there are.
        slots: of each, the largest number of steps that hold it.
    """
    steps = frame.size
    holds = frame == jnp.arange(frames)[:, None]
    first = jnp.argmax(holds, axis=1)
    step = first[:, None] + jnp.arange(slots)
    within = jnp.minimum(step, steps - 1)
    taken = (step < steps) & jnp.take_along_axis(holds, within, axis=1)
    return Holding(frame, jnp.arange(steps) - first[frame], within, taken)


@jax.custom_vjp
def by_frame(x: Float[Array, "T E D"], h: Holding) -> Float[Array, "K E S D"]:
    """Return what is told by step in the slots of each frame."""
    return x[h.step[:, None], jnp.arange(x.shape[1])[:, None]]


@jax.custom_vjp
def by_step(x: Float[Array, "K E S D"], h: Holding) -> Float[Array, "T E D"]:
    """Return what is told in the slots of each frame by step."""
    return x[h.frame, :, h.slot]


def repeat_frames(x: Float[Array, "K E D"], h: Holding) -> Float[Array, "T E D"]:
    """Return what is told of each frame at each step that holds it."""
    slots = jnp.broadcast_to(x[:, :, None], (*x.shape[:2], h.step.shape[1], x.shape[2]))
    return by_step(slots, h)


def _by_frame_backward(
    h: Holding, g: Float[Array, "K E S D"]
) -> tuple[Float[Array, "T E D"], None]:
    return by_step(g, h), None


def _by_step_backward(h: Holding, g: Float[Array, "T E D"]) -> tuple[Float[Array, "K E S D"], None]:
    return jnp.where(h.taken[:, None, :, None], by_frame(g, h), 0.0), None


by_frame.defvjp(lambda x, h: (by_frame(x, h), h), _by_frame_backward)
by_step.defvjp(lambda x, h: (by_step(x, h), h), _by_step_backward)
