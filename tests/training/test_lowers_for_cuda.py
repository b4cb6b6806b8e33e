"""The training program for a GPU, as far as a machine without one can hold it.

It is lowered for CUDA once, from shapes, without the CUDA plugin and without an array of a robot.
"""

import dataclasses
import functools
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

import jax
import pytest

from cref_jax import gpu_program
from cref_jax.config import presets
from cref_jax.training import iteration

pytestmark = pytest.mark.slow

ROBOTS = 64  # the program is the same for 4096, but for its sizes
LIBRARY = {"cusolver_potrf_ffi", "AllocateBuffer"}  # Cholesky, and room for results; no callback
# What the program may hold at most. A GPU's host may have to wait for each turn of a loop and each
# branch; operations are what tracing and compiling take their time for: 46,307 now, and six sorts.
MOST = {"while": 18, "case": 6, "sort": 7, "triangular_solve": 4, "operations": 46_500}


@functools.cache
def traced() -> jax.stages.Traced:
    c = presets.build_config("mixed", None, "gpu")
    c = dataclasses.replace(c, run=dataclasses.replace(c.run, num_envs=ROBOTS))
    return gpu_program.trace_iteration(c, "mjx", iteration.make_mesh())


@functools.cache
def lowered() -> str:
    return traced().lower(lowering_platforms=("cuda",)).as_text()


def products(program: Any, in_physics: bool = False) -> Iterator[tuple[Any, bool]]:
    """Yield the parameters of every dot_general, and whether an engine asks for it."""
    for equation in program.eqns:
        stack = equation.source_info.traceback
        files = [frame.file_name for frame in stack.frames] if stack else []
        inside = in_physics or any(file.endswith("mjx_engine.py") for file in files)
        if equation.primitive.name == "dot_general":
            yield equation.params, inside
        for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=is_program):
            if is_program(inner):
                yield from products(getattr(inner, "jaxpr", inner), inside)


def is_program(x: Any) -> bool:
    return hasattr(x, "eqns")


def test_training_lowers_for_cuda_without_a_call_to_the_host():
    calls = set(re.findall(r"custom_call @([\w.$]+)", lowered()))
    assert calls <= LIBRARY and "cusolver_potrf_ffi" in calls


def test_nothing_is_worked_out_in_double_precision():
    assert "f32" in lowered() and "f64" not in lowered()


def test_the_program_does_not_grow_unnoticed():
    found = Counter(re.findall(r"= \"?stablehlo\.(\w+)", lowered()))
    found["operations"] = found.total()
    assert {name: found[name] for name in MOST if found[name] > MOST[name]} == {}
    assert min(found[name] for name in MOST) > 0


def test_the_physics_asks_for_full_precision():
    of_physics = [params for params, inside in products(traced().jaxpr.jaxpr) if inside]
    highest = (jax.lax.Precision.HIGHEST,) * 2
    assert len(of_physics) > 50
    assert [params for params in of_physics if params["precision"] != highest] == []
