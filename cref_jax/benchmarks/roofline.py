"""What a machine can do, and what a function asks of it: the two sides of a roofline.

A stage can take no less time than its matrix products at the rate of a large one, and no less than
the arrays that it is given and gives at the rate of a copy.
"""

from collections.abc import Callable
from math import prod
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P

from cref_jax.benchmarks import warp_raycast
from cref_jax.training import iteration

SIDE = 1024  # of the square matrices whose product is timed
COPIED = 2**26  # bytes of the array whose copy is timed; more than a cache holds
REPEATS = 10


class Rates(NamedTuple):
    """What a device does at its best while all others do the same."""

    products: float  # FLOP/s of a matrix product in float32
    memory: float  # bytes/s read and written by a copy


class Work(NamedTuple):
    """What a function asks for."""

    flops: int  # of its matrix products
    moved: int  # bytes of its arguments and its results

    def seconds(self, rates: Rates) -> float:
        """Return the least time that it can take, s."""
        return max(self.flops / rates.products, self.moved / rates.memory)


def measure() -> Rates:
    """Time a large product and a large copy on every device at once: cores share their memory."""
    mesh = iteration.mesh_of(jax.device_count())
    each = lambda f: jax.jit(jax.shard_map(f, mesh=mesh, in_specs=P(), out_specs=P(iteration.AXIS)))
    square, long = jnp.ones((SIDE, SIDE)), jnp.ones(COPIED // 4)
    timed = lambda f, x: warp_raycast.shortest(lambda: jax.block_until_ready(f(x)), REPEATS)
    product, copy = each(lambda x: x @ x), each(lambda x: x + 1.0)
    return Rates(2 * SIDE**3 / timed(product, square), 2 * COPIED / timed(copy, long))


def work_of(function: Callable[..., Any], *arguments: Any) -> Work:
    """Count what a call does, loops as often as they turn; a loop of unknown length once."""
    traced, results = jax.make_jaxpr(function, return_shape=True)(*arguments)
    moved = sum(_bytes(x) for x in jax.tree.leaves((arguments, results)))
    return Work(_flops(traced.jaxpr), moved)


def _bytes(x: Any) -> int:
    keys = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return prod(x.shape) * (8 if keys else x.dtype.itemsize)


def _flops(jaxpr: Any) -> int:
    """Return the operations of all matrix products in a program; of its branches the most."""
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            left = equation.invars[0].aval.shape
            total += 2 * prod(equation.outvars[0].aval.shape) * prod(left[k] for k in contracted)
            continue
        name, inner = equation.primitive.name, _inner(equation)
        turns = equation.params["length"] if name == "scan" else 1
        total += turns * (max(inner, default=0) if name == "cond" else sum(inner))
    return total


def _inner(equation: Any) -> list[int]:
    """Return the operations of the programs that an equation runs."""
    found = []
    for value in equation.params.values():
        for part in value if isinstance(value, list | tuple) else (value,):
            part = getattr(part, "jaxpr", part)
            if hasattr(part, "eqns"):
                found.append(_flops(part))
    return found
