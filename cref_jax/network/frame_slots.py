"""Conversion between values per control step and values per frame and slot.

A frame is held for several control steps. All steps holding a frame query its tokens at once, so
the tokens are never repeated per step. A frame has one slot for each step that may hold it; a step
takes the next slot of its current frame, and unused slots affect no result. Each conversion is the
other's gradient, which avoids sums by index: on a GPU their order is not deterministic.
"""

from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@no_type_check  # vmap and tree.map put batches and non-arrays in it
@flax.struct.dataclass
class Holding:
    """The assignment of T steps to the S slots of each of K frames."""

    frame: Int[Array, " T"]
    slot: Int[Array, " T"]
    step: Int[Array, "K S"]  # the step in the slot
    taken: Bool[Array, "K S"]


def assign_slots(frame: Int[Array, " T"], frames: int, slots: int) -> Holding:
    """Assign each step to a slot of its frame.

    Args:
        frame: the current frame at each step; no frame returns after another one.
        frames: number of frames.
        slots: slots per frame, the maximum number of steps that hold it.
    """
    steps = frame.size
    holds = frame == jnp.arange(frames)[:, None]
    first = jnp.argmax(holds, axis=1)
    step = first[:, None] + jnp.arange(slots)
    within = jnp.minimum(step, steps - 1)
    taken = (step < steps) & jnp.take_along_axis(holds, within, axis=1)
    return Holding(frame, jnp.arange(steps) - first[frame], within, taken)


@jax.custom_vjp
def gather_by_frame(x: Float[Array, "T E D"], h: Holding) -> Float[Array, "K E S D"]:
    """Gather values per step into the slots of each frame."""
    return x[h.step[:, None], jnp.arange(x.shape[1])[:, None]]


@jax.custom_vjp
def gather_by_step(x: Float[Array, "K E S D"], h: Holding) -> Float[Array, "T E D"]:
    """Gather values in the slots of each frame into one per step."""
    return x[h.frame, :, h.slot]


def repeat_frames(x: Float[Array, "K E D"], h: Holding) -> Float[Array, "T E D"]:
    """Repeat the value of each frame at each step that holds it."""
    slots = jnp.broadcast_to(x[:, :, None], (*x.shape[:2], h.step.shape[1], x.shape[2]))
    return gather_by_step(slots, h)


def _gather_by_frame_backward(
    h: Holding, g: Float[Array, "K E S D"]
) -> tuple[Float[Array, "T E D"], None]:
    return gather_by_step(g, h), None


def _gather_by_step_backward(
    h: Holding, g: Float[Array, "T E D"]
) -> tuple[Float[Array, "K E S D"], None]:
    return jnp.where(h.taken[:, None, :, None], gather_by_frame(g, h), 0.0), None


gather_by_frame.defvjp(lambda x, h: (gather_by_frame(x, h), h), _gather_by_frame_backward)
gather_by_step.defvjp(lambda x, h: (gather_by_step(x, h), h), _gather_by_step_backward)
