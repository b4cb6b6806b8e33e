"""A recurrent cell over a horizon, with one product for the gradient of its recurrent kernel.

JAX would add up the gradient of the kernel step by step, a product of E rows each. Nothing in the
steps depends on it, so it is had from all steps at once, as one product of T * E rows.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

S = TypeVar("S")  # what a cell holds besides its output: an array [E, ...] or a tree of them
# (state, h_{t-1} [E, H], x_t [E, I], r_t [E, G]) -> (state, h_t [E, H])
Cell = Callable[[S, Array, Array, Array], tuple[S, Array]]
UNROLL = 4  # steps in a turn of the loop on an accelerator, which starts fewer kernels; assumed


def run(
    cell: Cell,
    memory: tuple[PyTree, Float[Array, "E H"]],
    x: Float[Array, "T E I"],
    offset: Float[Array, "T E G"],
    kernel: Float[Array, "H G"],
    begins: Bool[Array, "T E"],
) -> tuple[tuple[PyTree, Float[Array, "E H"]], Float[Array, "T E H"]]:
    """Return the memory after the last step, and h of all steps.

    (s_t, h_t) = cell(s_{t-1}, h_{t-1}, x_t, offset_t + h_{t-1} U), 0 at an episode's start.
    """

    @jax.custom_vjp
    def whole(memory, x, offset, kernel, begins):
        return _steps(cell, memory, x, offset, kernel, begins)

    def forward(memory, x, offset, kernel, begins):
        fixed = lambda memory, x, offset: _steps(cell, memory, x, offset, kernel, begins)
        result, pull = jax.vjp(fixed, memory, x, offset)
        before = jnp.concatenate([memory[1][None], result[1][:-1]])
        return result, (pull, jnp.where(begins[..., None], 0.0, before))

    def backward(kept, g):
        pull, before = kept
        to_memory, to_x, to_offset = pull(g)
        rows = lambda a: a.reshape(-1, a.shape[-1])
        return to_memory, to_x, to_offset, rows(before).T @ rows(to_offset), None

    whole.defvjp(forward, backward)
    return whole(memory, x, offset, kernel, begins)


def _steps(
    cell: Cell,
    memory: tuple[PyTree, Float[Array, "E H"]],
    x: Float[Array, "T E I"],
    offset: Float[Array, "T E G"],
    kernel: Float[Array, "H G"],
    begins: Bool[Array, "T E"],
) -> tuple[tuple[PyTree, Float[Array, "E H"]], Float[Array, "T E H"]]:
    """Do as `run` does, as JAX would differentiate it."""

    def step(memory: tuple[PyTree, Array], xs: tuple) -> tuple[tuple[PyTree, Array], Array]:
        x, offset, begin = xs
        empty = lambda m: jnp.where(begin[:, None], 0.0, m)
        state, h = jax.tree.map(empty, memory)
        state, h = cell(state, h, x, offset + h @ kernel)
        return (state, h), h

    unroll = 1 if jax.default_backend() == "cpu" else UNROLL
    return jax.lax.scan(step, memory, (x, offset, begins), unroll=unroll)
