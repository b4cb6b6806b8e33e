"""Where XLA for a CPU ends one kernel and begins the next.

It would rather compute a value again in each kernel that reads it, and again for each element where
a kernel reads it more than once: an index into the ground for each of seventeen columns, a search
for each of three coordinates. A loop of simple steps over arrays in memory is also one that the
CPU's vector units can run, and a fused one often is not.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
from jax.experimental.scheduling_groups import xla_metadata_call
from jaxtyping import PyTree

P = ParamSpec("P")
R = TypeVar("R")


def as_own_kernel(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function as one whose arguments and results are in memory, on a CPU.

    It computes the same. An accelerator has its own way to divide a program into kernels.
    """

    @functools.wraps(function)
    def called(*args: P.args, **kwargs: P.kwargs) -> R:
        if jax.default_backend() != "cpu":
            return function(*args, **kwargs)
        return xla_metadata_call(inlineable="false")(function)(*args, **kwargs)

    return called


def materialize(values: PyTree) -> PyTree:
    """Return values that an accelerator has in memory before anything reads them.

    XLA for a GPU would compute them within the kernel that reads them, and where that one turns
    them over, as patches of an image, element by element: on an H100 in 7 ms instead of one.
    """
    return jax.lax.optimization_barrier(values)
