"""A recurrent cell over a horizon, with one product for the gradient of its recurrent kernel.

JAX would sum the gradient of the kernel step by step, a product of E rows each. No step depends on
it, so it is computed for all steps at once, as one product of T * E rows.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

S = TypeVar("S")  # a cell's state besides its output: an array [E, ...] or a tree of them
# (state, h_{t-1} [E, H], x_t [E, I], r_t [E, G]) -> (state, h_t [E, H])
Cell = Callable[[S, Array, Array, Array], tuple[S, Array]]
UNROLL = 4  # steps per loop iteration on an accelerator, for fewer kernel launches; assumed


def run(
    cell: Cell,
    memory: tuple[PyTree, Float[Array, "E H"]],
    x: Float[Array, "T E I"],
    offset: Float[Array, "T E G"],
    kernel: Float[Array, "H G"],
    begins: Bool[Array, "T E"],
) -> tuple[tuple[PyTree, Float[Array, "E H"]], Float[Array, "T E H"]]:
    """Run a cell over all steps; return the memory after the last step, and h of all steps.

    (s_t, h_t) = cell(s_{t-1}, h_{t-1}, x_t, offset_t + h_{t-1} U), 0 at an episode's start.
    """

    @jax.custom_vjp
    def whole(memory, x, offset, kernel, begins):
        return _scan_steps(cell, memory, x, offset, kernel, begins)

    def forward(memory, x, offset, kernel, begins):
        fixed = lambda memory, x, offset: _scan_steps(cell, memory, x, offset, kernel, begins)
        result, pull = jax.vjp(fixed, memory, x, offset)
        before = jnp.concatenate([memory[1][None], result[1][:-1]])
        return result, (pull, jnp.where(begins[..., None], 0.0, before))

    def backward(residuals, g):
        pull, before = residuals
        to_memory, to_x, to_offset = pull(g)
        rows = lambda a: a.reshape(-1, a.shape[-1])
        return to_memory, to_x, to_offset, rows(before).T @ rows(to_offset), None

    whole.defvjp(forward, backward)
    return whole(memory, x, offset, kernel, begins)


def _scan_steps(
    cell: Cell,
    memory: tuple[PyTree, Float[Array, "E H"]],
    x: Float[Array, "T E I"],
    offset: Float[Array, "T E G"],
    kernel: Float[Array, "H G"],
    begins: Bool[Array, "T E"],
) -> tuple[tuple[PyTree, Float[Array, "E H"]], Float[Array, "T E H"]]:
    """Compute the same as `run`, with JAX's own gradient."""

    def step(memory: tuple[PyTree, Array], xs: tuple) -> tuple[tuple[PyTree, Array], Array]:
        x, offset, begin = xs
        empty = lambda m: jnp.where(begin[:, None], 0.0, m)
        state, h = jax.tree.map(empty, memory)
        state, h = cell(state, h, x, offset + h @ kernel)
        return (state, h), h

    unroll = 1 if jax.default_backend() == "cpu" else UNROLL
    return jax.lax.scan(step, memory, (x, offset, begins), unroll=unroll)
