"""Compile MuJoCo Warp's kernels for a GPU on a machine without one, to carry them to where it is.

Settling a few robots on the CPU shows which kernels the training options need, and with how many
threads per block; each is then compiled into the cache that WARP_CACHE_PATH names:

    experiments/warp_kernels.py --terrain mixed --experiment robust
"""

import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp  # pyright: ignore[reportMissingImports]
from warp._src import context  # pyright: ignore[reportMissingImports]

ARCHITECTURE = 90  # H100, H200


def main(arguments: list[str]) -> None:
    """Find the kernels of these training options, and compile them."""
    launched: dict[tuple[str, int], Any] = {}
    for name in ("launch", "launch_tiled"):
        setattr(warp, name, _record(getattr(context, name), launched))
    from cref_jax import train  # after the launches are recorded

    _, c = train.parse([*arguments, "--engine", "warp", "--device", "cpu"])
    train.build_world(c, "warp", 1)  # settles robots, and so takes every kind of step
    print(f"{len(launched)} kernels of {c.robot.name}, {c.terrain.name}", flush=True)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(_compile, launched.values(), [threads for _, threads in launched]))


def _record(launch: Callable, launched: dict[tuple[str, int], Any]) -> Callable:
    def recording(kernel: Any, *arguments: Any, block_dim: int = 256, **options: Any) -> Any:
        result = launch(kernel, *arguments, block_dim=block_dim, **options)
        launched[kernel.module.name, block_dim] = kernel.module  # complete once launched
        return result

    return recording


def _compile(module: Any, threads: int) -> None:
    """Compile as warp.compile_aot_module does, which knows one number of threads per module."""
    module.get_module_hash(threads)
    options = module.resolved_options[threads]
    module._compile(output_arch=ARCHITECTURE, use_ptx=False, options=options)


if __name__ == "__main__":
    main(sys.argv[1:])
