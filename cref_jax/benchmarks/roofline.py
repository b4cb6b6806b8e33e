"""Roofline model: peak rates of the machine and the work of a function.

The time of a stage is bounded below by its matrix products at the rate of a large product and by
its arguments and results at the rate of a copy.
"""

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from cref_jax.benchmarks import warp_raycast
from cref_jax.training import iteration

SIDE = 1024  # of the square matrices in the timed product
COPIED = 2**26  # bytes of the array in the timed copy; larger than the caches
REPEATS = 10


class Rates(NamedTuple):
    """Peak rates of one device while all devices are busy."""

    products: float  # FLOP/s of a matrix product in float32
    memory: float  # bytes/s read and written by a copy


class Work(NamedTuple):
    """Work of a function call."""

    flops: int  # of matrix products
    moved: int  # bytes of arguments and results

    def seconds(self, rates: Rates) -> float:
        """Compute the lower bound of the time, max(flops / products, moved / memory), s."""
        return max(self.flops / rates.products, self.moved / rates.memory)


def measure_rates() -> Rates:
    """Measure a large product and a large copy on all devices at once, as cores share memory."""
    mesh = iteration.make_mesh(jax.device_count())
    each = lambda f: jax.jit(jax.shard_map(f, mesh=mesh, in_specs=P(), out_specs=P(iteration.AXIS)))
    square, long = jnp.ones((SIDE, SIDE)), jnp.ones(COPIED // 4)
    timed = lambda f, x: warp_raycast.shortest_time(lambda: jax.block_until_ready(f(x)), REPEATS)
    product, copy = each(lambda x: x @ x), each(lambda x: x + 1.0)
    return Rates(2 * SIDE**3 / timed(product, square), 2 * COPIED / timed(copy, long))


def count_work(function: Callable[..., Any], *arguments: Any) -> Work:
    """Count the work of a call; loops count once per trip, loops of unknown length once."""
    traced, results = jax.make_jaxpr(function, return_shape=True)(*arguments)
    moved = sum(_count_bytes(x) for x in jax.tree.leaves((arguments, results)))
    return Work(_count_flops(traced.jaxpr), moved)


def _count_bytes(x: Any) -> int:
    keys = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return prod(x.shape) * (8 if keys else x.dtype.itemsize)


def _count_flops(jaxpr: Any) -> int:
    """Count the FLOPs of all matrix products in a program, of conditionals the largest branch."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            total += 2 * prod(equation.outvars[0].aval.shape) * prod(left[k] for k in contracted)
            continue
        name, inner = equation.primitive.name, _count_inner_flops(equation)
        trips = equation.params["length"] if name == "scan" else 1
        total += trips * (max(inner, default=0) if name == "cond" else sum(inner))
    return total


def _count_inner_flops(equation: Any) -> list[int]:
    """Count the FLOPs of each program nested in an equation."""
    counts = []
    for value in equation.params.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                counts.append(_count_flops(part))
    return counts
